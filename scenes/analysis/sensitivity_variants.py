"""What is not known of an operation, one thing at a time: variants of a body and of how a tool is aimed at it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.anatomy import Anatomy
from sim.effects import SKULLS
from sim.errors import InputError
from sim.loads import MAGNITUDE, Displaced, Loads, Pushed, stacked
from sim.material import BRAIN, Material
from surrogate.data.cortex_patch import Patch
from surrogate.data.tool_loads import across


@dataclass(frozen=True)
class Body:
    """What is pressed: the tissue, how many times as stiff the tumour is, the skull, the element.

    `skull` is one of `sim.effects.SKULLS`. Linear tetrahedra lock as nu nears 0.5, which would pass for an influence of
    nu: hence smoothed ones.
    """

    tissue: Material = BRAIN
    tumour: float = 1.0
    skull: str = "bonded"
    element: str = "smoothed"


@dataclass(frozen=True)
class Aim:
    """How a tool's load is off: its force or motion by a `share` and `turn`ed [rad], its point by a `shift` [m].

    In several ways each: more and less, about two axes, to four sides.
    """

    share: float = 0.0
    turn: float = 0.0
    shift: float = 0.0


@dataclass(frozen=True)
class Variant:
    """One thing changed: what, from where, to where, and the body and aim that say so."""

    what: str
    default: str
    now: str
    body: Body
    aim: Aim = Aim()


def variants(anatomy: Anatomy, body: Body, elements: Sequence[str] = ()) -> list[Variant]:
    """The tool's uncertainty, the tissue's, the skull's, and other `elements`."""
    tissue = body.tissue
    young, poisson, tumour = f"{tissue.young:g} Pa", f"{tissue.poisson:g}", f"{body.tumour:g} x brain"
    changed = [
        Variant("force or motion", "as drawn", "5 % off", body, Aim(share=0.05)),
        Variant("its direction", "as drawn", "2 deg off", body, Aim(turn=np.radians(2.0))),
        Variant("its position", "as drawn", "1 mm off", body, Aim(shift=1e-3)),
        *(
            Variant(
                "E", young, f"{step:+.0%}", replace(body, tissue=replace(tissue, young=(1.0 + step) * tissue.young))
            )
            for step in (-0.2, 0.2)
        ),
        *(
            Variant("nu", poisson, f"{nu:g}", replace(body, tissue=replace(tissue, poisson=nu)))
            for nu in (0.45, 0.49, 0.495)
        ),
        *(
            Variant("tumour's stiffness", tumour, f"{ratio:g} x", replace(body, tumour=ratio))
            for ratio in (0.5, 1.0, 2.0, 3.0)
        ),
    ]
    if anatomy.slide_normal.any():
        changed += [Variant("skull", body.skull, skull, replace(body, skull=skull)) for skull in SKULLS]
    changed += [Variant("element", body.element, element, replace(body, element=element)) for element in elements]
    return [variant for variant in changed if variant.body != body or variant.aim != Aim()]


def aimed(loads: Loads, aim: Aim, patch: Patch) -> Loads:
    """The loads of one tool as `aim` has them, one block for each way; points are shifted along the open cortex."""
    (cause,) = loads.causes
    if not isinstance(cause, Pushed | Displaced):
        raise InputError(f"loads of the kind {type(cause).__name__} have no aim: give `Pushed` or `Displaced`.")
    name = MAGNITUDE[type(cause)]
    vector = getattr(cause, name)
    vectors, points = [vector], [cause.point]
    if aim.share:
        vectors = [(1.0 + share) * vector for share in (aim.share, -aim.share)]
    if aim.turn:
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        turned = [np.sin(aim.turn) * length * way for way in across(vector / length)]
        vectors = [np.cos(aim.turn) * vector + aside for aside in turned]
    if aim.shift:
        first, second = across(patch.normal_near(cause.point))
        points = [cause.point + aim.shift * way for way in (first, -first, second, -second)]
    return stacked(
        [Loads((replace(cause, **{name: one, "point": point}),), loads.time) for one in vectors for point in points]
    )
