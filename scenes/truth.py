"""The finite elements' answer to every frame of a scene: what drawn frames are held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sim.accuracy import TRAIN
from sim.deformation import Deformation, joined
from sim.fem import Fem
from sim.loads import Loads, stacked

from .scene import Scene
from .theatre import Theatre


def truth_of(theatre: Theatre, scene: Scene, loads: Sequence[Loads]) -> Deformation:
    """One row per frame's loads, every vertex, at training accuracy; one after the other where the past matters."""
    fem = theatre.fem(scene, TRAIN)
    if not isinstance(fem, Fem) or fem.problem.plain:
        return fem.deform(stacked(loads))
    answers: list[Deformation] = []
    for load in loads:
        answers.append(fem.deform(load, start=answers[-1] if answers else None))
    return joined([replace(answer, history={}) for answer in answers])
