"""How cameras move, zoom and focus with time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from ar.optics.camera import Camera
from sim.errors import InputError

# Of a breath [Hz]: fifteen a minute.
BREATH = 0.25
# Of a hand that holds a camera [Hz]: it drifts slowly, and trembles at 8 to 12 Hz (Elble and Koller 1990, "Tremor").
SLOW, TREMOR = (0.2, 2.5), (8.0, 12.0)
# Waves of each, and the tremor's share of a hand's motion.
WAVES, SHARE = 8, 0.1


class CameraPath(Protocol):
    """A pure function of the camera as it starts, the point that it looks at (3,) [m], and a time [s]."""

    def __call__(self, camera: Camera, target: np.ndarray, time: float) -> Camera:
        """The camera at that time."""
        ...


@dataclass(frozen=True)
class HandHeld:
    """A camera in somebody's hand, who breathes: the same seed moves it in the same way.

    Parameters
    ----------
    shift, turn
        How far the hand moves and turns it along and about each axis, as standard deviations [m], [rad].
    breath
        How far a breath lifts and lowers it [m].

    Raises
    ------
    InputError
        A seed below 0.
    """

    seed: int = 0
    shift: float = 1.0e-3
    turn: float = float(np.radians(0.25))
    breath: float = 1.5e-3

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"a hand has the seed {self.seed}: give a whole number that is not below 0.")

    def __call__(self, camera: Camera, target: np.ndarray, time: float) -> Camera:
        """The camera at a time [s]."""
        way = wandering(self.seed, time)
        lifted = np.array([0.0, self.breath * np.sin(2.0 * np.pi * BREATH * time), 0.0])
        turn = self.turn * way[3:]
        moved = camera.moved(self.shift * way[:3] + lifted)
        angle = float(np.linalg.norm(turn))
        return moved.perturbed(np.degrees(angle), tuple(turn)) if angle > 0.0 else moved


@dataclass(frozen=True)
class Orbit:
    """A camera that swings to and fro about what it looks at, and keeps looking at it.

    `reach` [rad] to each side, about the upright axis of its picture; `period` [s].

    Raises
    ------
    InputError
        A period that is not above 0.
    """

    reach: float = float(np.radians(20.0))
    period: float = 4.0

    def __post_init__(self) -> None:
        if not 0.0 < self.period < np.inf:
            raise InputError(f"an orbit has a period of {self.period} s: give a number above 0.")

    def __call__(self, camera: Camera, target: np.ndarray, time: float) -> Camera:
        """The camera at a time [s]."""
        degrees = np.degrees(self.reach * np.sin(2.0 * np.pi * time / self.period))
        to_target = camera.in_frame(np.asarray(target))
        # About the target in place of the camera's own centre.
        return camera.moved(to_target).perturbed(degrees).moved(-to_target)


@dataclass(frozen=True)
class Focus:
    """What a microscope is set to from a time [s] on: times its first working distance, and times its first zoom."""

    since: float
    distance: float
    zoom: float


@dataclass(frozen=True)
class Microscope:
    """A microscope that is moved along its axis, zoomed and focused again on what it looks at.

    Parameters
    ----------
    settings
        What it is set to, in the order of time.
    takes
        How long each change takes [s].
    focal_length
        Of the lens that focuses [m]: pictures grow a little as it focuses nearer. It is shorter than all distances.

    Raises
    ------
    InputError
        Settings without order, or a change that takes no time; a distance or a zoom that is not above 0.
    """

    settings: tuple[Focus, ...] = (Focus(0.8, 1.0, 1.6), Focus(2.0, 1.25, 1.0), Focus(3.0, 1.0, 1.0))
    takes: float = 0.5
    focal_length: float = 30e-3

    def __post_init__(self) -> None:
        times = [setting.since for setting in self.settings]
        if times != sorted(times) or not self.takes > 0.0:
            raise InputError(f"a microscope is set at {times} s in {self.takes} s each: give times in order, above 0.")
        if not all(0.0 < number < np.inf for each in self.settings for number in (each.distance, each.zoom)):
            raise InputError("a microscope's distances and zooms are multiples of the first: give numbers above 0.")

    def __call__(self, camera: Camera, target: np.ndarray, time: float) -> Camera:
        """The camera at a time [s]."""
        distance, zoom = 1.0, 1.0
        for setting in self.settings:
            share = np.clip((time - setting.since) / self.takes, 0.0, 1.0)
            share = float(share * share * (3.0 - 2.0 * share))
            distance += share * (setting.distance - distance)
            zoom *= (setting.zoom / zoom) ** share
        first = float(camera.in_frame(np.asarray(target))[2])
        moved = camera.moved(np.array([0.0, 0.0, first - distance * first]))
        return moved.refocused(self.focal_length, first, distance * first).zoomed(zoom)


@lru_cache(maxsize=16)
def waves(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies [Hz], phases [rad] and amplitudes of a hand's motion, each (6, n), for 3 shifts and 3 turns."""
    random = np.random.default_rng(seed)
    bands = [random.uniform(*band, (6, WAVES)) for band in (SLOW, TREMOR)]
    sizes = [np.full((6, WAVES), size * np.sqrt(2.0 / WAVES)) for size in (1.0, SHARE)]
    return np.hstack(bands), random.uniform(0.0, 2.0 * np.pi, (6, 2 * WAVES)), np.hstack(sizes)


def wandering(seed: int, time: float) -> np.ndarray:
    """Six numbers (6,) that wander with time [s] about 0, with a standard deviation of 1."""
    frequencies, phases, sizes = waves(seed)
    return (sizes * np.sin(2.0 * np.pi * frequencies * time + phases)).sum(axis=1)


PATHS: dict[str, Callable[[int], CameraPath]] = {
    "hand-held": HandHeld,
    "microscope": lambda seed: Microscope(),
    "orbit": lambda seed: Orbit(),
}
"""Paths by name, each from a seed."""
