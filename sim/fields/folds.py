"""Whether a field folds space, and how folds outside the body are smoothed away."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from .extension import smooth

# Cells so much compressed or worse are smoothed, together with nodes so near; so often, with so many sweeps.
TIGHT, ROUND, TIMES, SWEEPS = 0.1, 3, 20, 8
# Slices that are looked at together: bounds the memory that it takes.
TOGETHER = 16


def jacobians(field: np.ndarray, spacing: float) -> np.ndarray:
    """Determinants (I - 1, J - 1, K - 1) of 1 + the gradient of a field (3, I, J, K) [m], cells of a spacing [m].

    Gradients are differences along the three edges that meet at a cell's first node. Below 0 the field folds there.
    """
    found = np.empty(tuple(side - 1 for side in field.shape[1:]), np.float32)
    for first in range(0, len(found), TOGETHER):
        part = field[:, first : first + TOGETHER + 1] / np.float32(spacing)
        here = part[:, :-1, :-1, :-1]
        ax, ay, az = part[:, 1:, :-1, :-1] - here
        bx, by, bz = part[:, :-1, 1:, :-1] - here
        cx, cy, cz = part[:, :-1, :-1, 1:] - here
        for diagonal in (ax, by, cz):
            diagonal += 1.0
        found[first : first + TOGETHER] = ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx)
    return found


def unfold(field: np.ndarray, fixed: np.ndarray, spacing: float) -> float:
    """Smooth a field (3, I, J, K) [m] in place where it folds, or nearly, but at fixed nodes (I, J, K).

    Returns the least determinant that is left.
    """
    found = jacobians(field, spacing)
    for _ in range(TIMES):
        bad = np.argwhere(found < TIGHT)
        if not len(bad):
            break
        low = np.maximum(bad.min(axis=0) - ROUND - 2, 0)
        high = np.minimum(bad.max(axis=0) + ROUND + 3, fixed.shape)
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        cells = tuple(slice(a, b - 1) for a, b in zip(low, high, strict=True))
        near = np.pad(found[cells] < TIGHT, [(0, 1)] * 3)
        near = ndimage.binary_dilation(near, iterations=ROUND) & ~fixed[window]
        if not near.any():
            break
        part = field[(slice(None), *window)]
        smooth(part, near, SWEEPS)
        found[cells] = jacobians(part, spacing)
    return float(found.min())
