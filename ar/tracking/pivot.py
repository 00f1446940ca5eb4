"""Where a tool's tip is in the tool's frame, from its poses while the tip stays in one place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FEWEST_POSES = 10
# Root mean square angle [rad] by which every direction in the tool must turn.
LEAST_TILT = np.radians(5.0)
# Root mean square distance [m]: 0.5 mm and 0.5 degrees of a tracker's noise, at a tip 300 mm away, give 2.7 mm.
LARGEST_RMS = 3e-3


@dataclass(frozen=True, eq=False)
class Pivot:
    """A calibrated tip.

    Parameters
    ----------
    tip
        (3,) in the tool's frame [m].
    centre
        (3,) where it stood, in the frame of the poses [m].
    covariance
        (6, 6) of tip and centre [m^2].
    rms
        Root mean square distance [m] between the centre and the tip at each pose.
    tilt
        Root mean square angle [rad] by which that direction in the tool turned that turned least.
    distances
        (n,) between the centre and the tip at each pose [m].
    """

    tip: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray
    rms: float
    tilt: float
    distances: np.ndarray

    @property
    def misfit(self) -> str:
        """Residual and its limit in words; empty within the limit."""
        if self.rms <= LARGEST_RMS:
            return ""
        return f"the tip moves by {1e3 * self.rms:.1f} mm (rms): at most {1e3 * LARGEST_RMS:.0f} mm are required"


def pivoted(poses: np.ndarray) -> Pivot:
    """The tip from poses of the tool (n, 4, 4) [m], x_world = T x_tool: all R_i tip + p_i are one place.

    Algebraic least squares. Yaniv (2015), "Which pivot calibration?", the one-step method: R_i tip - centre = -p_i.

    Raises
    ------
    ValueError
        Too few poses, or too little rotation.
    """
    count = len(poses)
    if count < FEWEST_POSES:
        raise ValueError(f"{count} poses are too few: hold the tip in one place, and record {FEWEST_POSES} or more.")
    turns, places = poses[:, :3, :3], poses[:, :3, 3]
    mean = turns.mean(axis=0)
    # The tip's normal matrix over n, after the centre is eliminated: how far each direction in the tool turns.
    tilt = float(np.sqrt(max(np.linalg.eigvalsh(np.eye(3) - mean.T @ mean)[0], 0.0)))
    if tilt < LEAST_TILT:
        raise ValueError(
            f"a direction in the tool turns by {np.degrees(tilt):.1f} degrees only (rms), and "
            f"{np.degrees(LEAST_TILT):.0f} are needed: tilt the tool by 30 degrees to all sides while its tip stays."
        )
    system = np.concatenate([turns, np.broadcast_to(-np.eye(3), (count, 3, 3))], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(system, -places.ravel(), rcond=None)[0]
    residuals = system @ solution + places.ravel()
    variance = residuals @ residuals / (3 * count - 6)
    covariance = variance * np.linalg.inv(system.T @ system)
    distances = np.linalg.norm(residuals.reshape(-1, 3), axis=1)
    rms = float(np.sqrt(distances @ distances / count))
    return Pivot(solution[:3], solution[3:], 0.5 * (covariance + covariance.T), rms, tilt, distances)
