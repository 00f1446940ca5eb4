"""Steps in time that one preconditioner serves: inertia grows with 1/dt^2, and a factor of two of it does no harm."""

from __future__ import annotations

import numpy as np

# Longer steps [s] have the preconditioner of statics. Brain in its skull sways at 1 Hz or faster: beside its stiffness
# inertia is then less than a thousandth.
LONGEST = 8.0
# So many preconditioners are kept: each is as large as that of statics.
KEPT = 3


def quantised(steps: np.ndarray) -> np.ndarray:
    """The powers of two (B,) [s] nearest to steps (B,) [s], by ratio; infinite for long steps, zero for none at all."""
    within = (steps > 0.0) & (steps < LONGEST)
    powers = np.exp2(np.round(np.log2(np.where(within, steps, 1.0))))
    return np.where(within, powers, np.where(steps > 0.0, np.inf, 0.0))


def alike(steps: np.ndarray, most: int) -> list[tuple[float, np.ndarray]]:
    """Batches of at most so many cases, of steps (B,) [s] as good as alike: the step, and the rows (k,) of each."""
    paces = quantised(steps)
    return [
        (float(pace), rows[first : first + most])
        for pace in np.unique(paces)
        for rows in [np.flatnonzero(paces == pace)]
        for first in range(0, len(rows), most)
    ]
