"""The finite elements' answer to every frame of a scene, in one batch: what drawn frames are held against."""

from __future__ import annotations

from collections.abc import Sequence

from sim.accuracy import TRAIN
from sim.deformation import Deformation
from sim.loads import Loads, stacked

from .scene import Scene
from .theatre import Theatre


def truth_of(theatre: Theatre, scene: Scene, loads: Sequence[Loads]) -> Deformation:
    """One row per frame's loads, every vertex, at training accuracy."""
    return theatre.fem(scene, TRAIN).deform(stacked(loads))
