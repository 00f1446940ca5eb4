"""Bodies of a data set whose trained model is off by more than it may be, as the models' own files say."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from sim.errors import InputError
from surrogate.model.left_out import OffBy
from surrogate.model.store import stated_errors

from ..play.deformers import model_path
from .bodies import ANATOMY
from .run_folder import BODIES

MOST_SAID = 10
"""Bodies that are named one by one."""


def models_of(folder: Path) -> dict[int, OffBy]:
    """How far off the models of a folder's bodies are, by number; bodies without a model of their own are left out."""
    found = {}
    for path in sorted((folder / BODIES).glob("[0-9]*")):
        with suppress(InputError, ValueError):  # what has no model, or none that can be read, plays nothing
            found[int(path.name)] = min(stated_errors(model_path(path / ANATOMY)).values(), key=lambda one: one.bound)
    return found


def weak_of(models: Mapping[int, OffBy]) -> dict[int, OffBy]:
    """Those that are weak, the worst first."""
    return dict(sorted(((number, one) for number, one in models.items() if one.weak), key=lambda each: -each[1].bound))


def said_of_weak(models: Mapping[int, OffBy]) -> list[str]:
    """Which models are weak, and by how much, in sentences; none where none is."""
    weak = weak_of(models)
    if not weak:
        return []
    return [
        f"{len(weak)} of {len(models)} bodies with a model have a weak one, by loads on cortex that it was not trained "
        "on. More `bodies.learner.loads`, or another learner, make better ones: in a new plan and folder.",
        *(f"- body {number}: {one}" for number, one in list(weak.items())[:MOST_SAID]),
        *([f"- and {len(weak) - MOST_SAID} more"] if len(weak) > MOST_SAID else []),
    ]


def weak_as_json(models: Mapping[int, OffBy]) -> list[dict[str, float | int | None]]:
    """The weak ones as numbers."""
    return [
        {
            "body": number,
            "bound_mm": 1e3 * one.bound,
            "mean_share_of_motion": None if one.left_out is None else one.left_out.mean,
        }
        for number, one in weak_of(models).items()
    ]
