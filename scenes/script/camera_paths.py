"""Camera motion, zoom and focus as functions of time."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from ar.optics.camera import Camera
from sim.errors import InputError

BREATHING_FREQUENCY = 0.25  # Breathing frequency [Hz]: fifteen breaths a minute.


@dataclass(frozen=True)
class HandSettings:
    """Settings of `sample_hand_motion`."""

    # Frequencies of the slow drift of a hand that holds a camera [Hz].
    drift_frequencies: tuple[float, float] = (0.2, 2.5)
    # Frequencies of a hand's tremor [Hz] (Elble and Koller 1990, "Tremor").
    tremor_frequencies: tuple[float, float] = (8.0, 12.0)
    wave_count: int = 8  # Number of waves of drift, and of tremor.
    tremor_share: float = 0.1  # Size of the tremor relative to the drift.


class CameraPath(Protocol):
    """Camera motion: a pure function of the initial camera, the target point (3,) [m] and a time [s]."""

    def __call__(self, camera: Camera, target: np.ndarray, time: float) -> Camera:
        """Return the camera at a time [s]."""
        ...


@dataclass(frozen=True)
class HandHeld:
    """Hand-held camera with breathing motion; equal seeds give equal motions.

    Parameters
    ----------
    shift, turn
        Standard deviations of the translation along each axis [m], and of the rotation about each axis [rad].
    breath
        Amplitude of the breathing motion [m].

    Raises
    ------
    InputError
        The seed is below 0.
    """

    seed: int = 0
    shift: float = 1.0e-3
    turn: float = float(np.radians(0.25))
    breath: float = 1.5e-3

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"a hand has the seed {self.seed}: give a whole number that is not below 0.")

    def __call__(self, camera: Camera, target: np.ndarray, time: float) -> Camera:
        """Return the camera at a time [s]."""
        way = sample_hand_motion(self.seed, time)
        lifted = np.array([0.0, self.breath * np.sin(2.0 * np.pi * BREATHING_FREQUENCY * time), 0.0])
        turn = self.turn * way[3:]
        moved = camera.move(self.shift * way[:3] + lifted)
        angle = float(np.linalg.norm(turn))
        return moved.perturb(np.degrees(angle), tuple(turn)) if angle > 0.0 else moved


@dataclass(frozen=True)
class Orbit:
    """Camera that swings around its target, and always looks at the target.

    The rotation about the vertical image axis has the amplitude `reach` [rad] and the `period` [s].

    Raises
    ------
    InputError
        The period is not > 0.
    """

    reach: float = float(np.radians(20.0))
    period: float = 4.0

    def __post_init__(self) -> None:
        if not 0.0 < self.period < np.inf:
            raise InputError(f"an orbit has a period of {self.period} s: give a number above 0.")

    def __call__(self, camera: Camera, target: np.ndarray, time: float) -> Camera:
        """Return the camera at a time [s]."""
        degrees = np.degrees(self.reach * np.sin(2.0 * np.pi * time / self.period))
        to_target = camera.to_camera_frame(np.asarray(target))
        # Rotate about the target instead of the camera's centre.
        return camera.move(to_target).perturb(degrees).move(-to_target)


@dataclass(frozen=True)
class Focus:
    """Microscope setting from the time `since` [s]: working distance and zoom relative to their initial values."""

    since: float
    distance: float
    zoom: float


@dataclass(frozen=True)
class Microscope:
    """Microscope that moves along its axis, zooms, and refocuses on its target.

    Parameters
    ----------
    settings
        Settings, in temporal order.
    takes
        Duration of each change of the setting [s].
    focal_length
        Focal length of the focusing lens [m], shorter than all distances. The magnification increases slightly at
        nearer focus.

    Raises
    ------
    InputError
        Settings that are not in temporal order, or a duration, distance or zoom that is not > 0.
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
        """Return the camera at a time [s]."""
        distance, zoom = 1.0, 1.0
        for setting in self.settings:
            share = np.clip((time - setting.since) / self.takes, 0.0, 1.0)
            share = float(share * share * (3.0 - 2.0 * share))
            distance += share * (setting.distance - distance)
            zoom *= (setting.zoom / zoom) ** share
        first = float(camera.to_camera_frame(np.asarray(target))[2])
        moved = camera.move(np.array([0.0, 0.0, first - distance * first]))
        return moved.refocus(self.focal_length, first, distance * first).zoom(zoom)


@lru_cache(maxsize=16)
def sample_hand_waves(seed: int, settings: HandSettings = HandSettings()) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample frequencies [Hz], phases [rad] and amplitudes, each (6, n), of a hand's 3 translations and 3 rotations."""
    random = np.random.default_rng(seed)
    count, frequencies = settings.wave_count, (settings.drift_frequencies, settings.tremor_frequencies)
    bands = [random.uniform(*band, (6, count)) for band in frequencies]
    sizes = [np.full((6, count), size * np.sqrt(2.0 / count)) for size in (1.0, settings.tremor_share)]
    return np.hstack(bands), random.uniform(0.0, 2.0 * np.pi, (6, 2 * count)), np.hstack(sizes)


def sample_hand_motion(seed: int, time: float, settings: HandSettings = HandSettings()) -> np.ndarray:
    """Compute the normalised hand motion (6,) at a time [s]: smooth functions with mean 0 and unit deviation."""
    frequencies, phases, sizes = sample_hand_waves(seed, settings)
    return (sizes * np.sin(2.0 * np.pi * frequencies * time + phases)).sum(axis=1)


PATHS: dict[str, Callable[[int], CameraPath]] = {
    "hand-held": HandHeld,
    "microscope": lambda seed: Microscope(),
    "orbit": lambda seed: Orbit(),
}
"""Functions that build a camera path from a seed, by name."""
