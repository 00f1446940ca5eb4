"""Observation models of the open cortex with their errors: the only input of an estimate of the tumour position."""

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError


@dataclass(frozen=True)
class PointObservation:
    """Observation of moving points of the open cortex, with errors. Force and tissue are unknown.

    Points occluded by the tool are not observed. The contact point of its tip is observed too.

    Parameters
    ----------
    points
        Number of points, evenly by area inside the drape's hole; the same in all frames.
    white, smooth
        Errors along each axis, as standard deviations [m]. The white one is independent between points and frames; the
        smooth one is constant in time and spatially correlated over 15 mm.
    shift, turn
        Size of the rigid error, constant in time: a translation [m], and a rotation [rad] about the points' centroid.
    seed
        Seed of points and errors: the same seed gives the same images.
    """

    points: int = 100
    white: float = 0.3e-3
    smooth: float = 0.5e-3
    shift: float = 0.7e-3
    turn: float = float(np.radians(0.3))
    seed: int = 0


@dataclass(frozen=True)
class StereoObservation:
    """Observation of points of the open cortex by the stereo images of an operating microscope.

    The first stereo pair shows the undeformed brain. Points are detected in images: their depth by stereo, their motion
    by the left image. The scan shows no vessels, so synthetic ones are drawn on the cortex.

    Parameters
    ----------
    points
        Number of points searched, evenly over the drape's hole.
    noise
        Standard deviation of the image noise [grey level of 255], independent between images.
    darker
        Relative loss of brightness of the right eye, 0 <= `darker` < 1.
    shift, turn
        Size of the rigid error of a tracked microscope: a translation [m], and a rotation [rad] about the centre of the
        opening. The first pair has its own error; all later ones share another.
    named
        True if points are tracked. Otherwise they are a point cloud without correspondences in the scan.
    vessels
        True if vessels are drawn.
    seed
        Seed of vessels, noise and rigid errors: the same seed gives the same images.

    Raises
    ------
    InputError
        `darker` is not in [0, 1), fewer than 6 points, or a size below 0.
    """

    points: int = 150
    noise: float = 2.0
    darker: float = 0.15
    shift: float = 0.7e-3
    turn: float = float(np.radians(0.3))
    named: bool = True
    vessels: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.darker < 1.0:
            raise InputError(f"an eye lacks {self.darker} of its light: give a share from 0 to below 1.")
        if self.points < 6 or not min(self.noise, self.shift, self.turn, self.seed) >= 0:
            raise InputError("a pair of eyes sees 6 points at least; noise, shift, turn and seed are not below 0.")
