"""Two cameras side by side, as the eyes of an operating microscope."""

from __future__ import annotations

import numpy as np

from .camera import Camera

BASELINE = 24e-3
"""Between the two ways of light of an operating microscope [m]."""


def stereo_pair(
    camera: Camera, baseline: float = BASELINE, working_distance: float | None = None
) -> tuple[Camera, Camera]:
    """The left and the right camera about one in the middle, `baseline` [m] apart along its rows.

    Parameters
    ----------
    working_distance
        How far ahead of the middle the two axes meet [m]; None: they are parallel, and rows of both pictures show the
        same.

    Raises
    ------
    ValueError
        A baseline or a distance that is not a number above 0.
    """
    if not 0.0 < baseline < np.inf or (working_distance is not None and not 0.0 < working_distance < np.inf):
        raise ValueError(f"a baseline of {baseline} m, a distance of {working_distance} m: give numbers above 0.")
    inwards = 0.0 if working_distance is None else float(np.degrees(np.arctan2(0.5 * baseline, working_distance)))
    half = np.array([0.5 * baseline, 0.0, 0.0])
    return camera.moved(-half).perturbed(-inwards), camera.moved(half).perturbed(inwards)
