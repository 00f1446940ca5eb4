"""A short drawn film whose markers are covered for a while, on a brain whose motion under the tool is known exactly."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, replace

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.pictures import Named, in_colour
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Deformer
from sim.loads import Loads, Touching
from surrogate.model.learned import predicted

from ..play.deformers import Theatre
from ..play.player import Player
from ..play.stage import Stage
from ..script.camera_paths import HandHeld
from ..script.scene import find_scene
from ..script.site import Site
from .filming import USUAL, VIEW, Mounted, Shot, Taking, Trouble, from_where_it_sees_all, mounted, shots_of

SCENE = "palpate"
"""The scene that is filmed."""
CAMERA = USUAL.sized(800, 600, scale=True)
"""Its camera: fewer pixels than usual, so that it takes seconds."""
# Pictures a second, how long it is, and when in the scene it begins: the ball begins to touch at 0.4 s [s].
RATE, LENGTH, BEGIN = 10.0, 1.7, 0.5
# What is covered and left out, and when [s].
TROUBLES = (Trouble("reference", 0.25, 0.55), Trouble("tool", 0.85, 1.05), Trouble("gap", 1.25, 1.55))
# How far round a tool's tip tissue goes with it [m].
ROUND = 25e-3


@dataclass(frozen=True, eq=False)
class Dent:
    """A Deformer that solves nothing: tissue goes with the tool's tip, the less the farther it is from it."""

    anatomy: Anatomy
    site: Site

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Where the tissue is under tools at poses; it is as deep as their tip is under the open cortex."""
        nodes = self.anatomy.mesh.nodes
        cause = loads.of(Touching)
        assert cause is not None
        moved = []
        for tip in cause.pose[:, 0, :3, 3]:
            place = self.site.nearest(tip).point
            depth = max(0.0, float((tip - place) @ self.site.axis))
            share = np.exp(-np.square(nodes - place).sum(axis=1) / (2.0 * ROUND**2))
            moved.append(depth * share[:, None] * self.site.axis)
        exact = np.zeros((2, len(loads)))
        found = predicted(
            np.stack(moved), np.arange(len(nodes)), loads, [False] * len(loads), clock.perf_counter(), exact, ""
        )
        return found if at is None else found.at(at)


@dataclass(frozen=True, eq=False)
class DrawnFilm:
    """Pictures with all that is true of them.

    Parameters
    ----------
    stage, mounts, calibration, deformer
        What is filmed, what is printed, by which camera, and who knows how the brain moves.
    shots
        In the order of their times.
    taking
        With what is covered, and when.
    """

    stage: Stage
    mounts: Mounted
    calibration: Calibration
    deformer: Deformer
    shots: tuple[Shot, ...]
    taking: Taking

    def picture(self, shot: Shot) -> Named:
        """A picture as a film gives it."""
        return in_colour(f"{shot.time:.1f} s", shot.colour, shot.time)


def drawn_film(theatre: Theatre) -> DrawnFilm:
    """The film of a theatre's body.

    Raises
    ------
    InputError
        An anatomy without open cortex.
    """
    view = replace(VIEW.calibrated(CAMERA), path=HandHeld(0))
    whole = find_scene(SCENE)
    scene = replace(
        whole, path=lambda time: whole.path(time + BEGIN), viewpoint=from_where_it_sees_all(view),
        frames_per_second=RATE, duration=LENGTH,
    )  # fmt: skip
    stage = theatre.stage(scene)
    deformer = Dent(theatre.anatomy, stage.site)
    player = Player(stage, deformer)
    mounts, taking = mounted(player), Taking(troubles=TROUBLES)
    return DrawnFilm(stage, mounts, CAMERA, deformer, tuple(shots_of(player, mounts, taking)), taking)
