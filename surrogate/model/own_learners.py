"""User-defined learners, registered from a file or a package, and used like the built-in learners."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TypeVar

from sim.errors import InputError

from ..data.encode import ENCODERS, Encoder
from ..regressors.protocol import Regressor

ENTRY_POINT_GROUP = "sulcus.learners"
"""Entry-point group of packages that provide learners; each entry point has its learner's name."""
RESERVED_NAMES = frozenset(
    [
        "ann",
        "contact",
        "contact-gp",
        "gp",
        "linear",
        "pairs",
        "pcr",
        "remainder",
        "residual",
        "series",
        "series-gp",
        "svr",
    ]
)
"""Names of built-in learners."""
PLAYER_NAMES = frozenset(["auto", "fem", "guarded"])
"""Names of deformers that are not learners, and so cannot be learner names."""


@dataclass(frozen=True)
class OwnLearner:
    """User-defined learner that is registered: its encoder, a name in `ENCODERS`, and the class of its regressor."""

    encoder: str
    regressor: type[Regressor]


OWN_LEARNERS: dict[str, OwnLearner] = {}  # User-defined learners, by name.
K = TypeVar("K", bound=type[Regressor])  # Type of a registered class.


def register_learner(name: str, encoder: str | Encoder = "tool") -> Callable[[K], K]:
    """Return a class decorator that registers a `Regressor` under a name; the class is instantiated without arguments.

    `encoder` computes the features to train on: a name in `encode.ENCODERS`, or a function (Patch, Pushed) -> (B, f).

    Raises
    ------
    InputError
        The name is taken, the encoder is unknown, or the class lacks a method of `Regressor`.
    """
    if callable(encoder):
        ENCODERS[name], encoder = encoder, name
    elif encoder not in ENCODERS:
        raise InputError(f"no encoder is called {encoder!r}: choose one of {', '.join(ENCODERS)}, or give a function.")

    def register(regressor: K) -> K:
        missing = [what for what in ("fit", "predict", "state", "restored") if not hasattr(regressor, what)]
        if missing:
            raise InputError(f"the learner {name} has no {', '.join(missing)}: see surrogate.Regressor.")
        if name in RESERVED_NAMES | PLAYER_NAMES or (
            name in OWN_LEARNERS and _get_file(OWN_LEARNERS[name].regressor) != _get_file(regressor)
        ):
            raise InputError(f"the name {name!r} is taken: give the learner another.")
        OWN_LEARNERS[name] = OwnLearner(encoder, regressor)
        return regressor

    return register


def find_own_learner(name: str) -> OwnLearner | None:
    """Return a registered learner, or import the package whose entry point has that name; None if there is neither.

    Raises
    ------
    InputError
        The package cannot be imported, or does not register a learner under its entry point's name.
    """
    if name in OWN_LEARNERS:
        return OWN_LEARNERS[name]
    for point in entry_points(group=ENTRY_POINT_GROUP, name=name):
        try:
            point.load()
        except Exception as error:
            raise InputError(f"the learner {name} of {point.value} cannot be loaded ({error}).") from error
        if name not in OWN_LEARNERS:
            raise InputError(f"{point.value} registers no learner called {name}: let it say @learner({name!r}).")
        return OWN_LEARNERS[name]
    return None


def find_learner_name(regressor_class: type) -> str | None:
    """Return the name under which a class was registered; None if it was not."""
    return next((name for name, own in OWN_LEARNERS.items() if own.regressor is regressor_class), None)


def _get_file(regressor: type) -> str | None:
    """Return the path of the file that defines a class, since an edited file may register its learner again."""
    return getattr(sys.modules.get(regressor.__module__), "__file__", None)
