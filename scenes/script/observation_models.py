"""Observation models of the open cortex with their errors; observations are the only input of a tumour estimate."""

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError


@dataclass(frozen=True)
class PointObservation:
    """Observation of tracked points of the open cortex, with errors. Force and tissue are not observed.

    Points that the tool occludes are not observed. The contact point of the tool is also observed.

    Parameters
    ----------
    points
        Number of points, random with uniform density inside the drape's hole; the same points in all frames.
    white, smooth
        Standard deviations of two errors along each axis [m]. The white error is independent between points and
        frames; the smooth error is constant in time and spatially correlated over 15 mm.
    shift, turn
        Size of the rigid error, constant in time: translation [m], and rotation [rad] about the points' centroid.
    seed
        Seed of points and errors; equal seeds give equal observations.
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

    The first stereo pair shows the undeformed brain. Points are tracked in the left images, and triangulated in each
    stereo pair. Since the scan shows no vessels, synthetic vessels are drawn on the cortex.

    Parameters
    ----------
    points
        Approximate number of searched points, on a regular grid over the drape's hole.
    noise
        Standard deviation of the image noise [grey level of 255], independent between images.
    darker
        Relative loss of brightness of the right eye, 0 <= `darker` < 1.
    shift, turn
        Size of the rigid error of the tracked microscope: translation [m], and rotation [rad] about the centre of the
        craniotomy. The first pair has one error, and all later pairs share another error.
    named
        True if points are tracked; False if they are a point cloud without correspondences in the scan.
    vessels
        True if vessels are drawn.
    seed
        Seed of vessels, noise and rigid errors; equal seeds give equal images.

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
