"""Height of the fluid around a brain, from a fraction of the brain's height."""

import numpy as np

# Distance of the fluid level above the highest (full) or below the lowest (drained) vertex [m].
LEVEL_MARGIN = 1e-3


def compute_fluid_level(nodes: np.ndarray, down: np.ndarray, fill_fraction: float) -> float:
    """Return the level [m] above the origin, against the unit vector `down` (3,), for nodes (V, 3) [m].

    `fill_fraction` ranges from 0 (drained) to 1 (above the highest vertex).
    """
    height = -nodes @ down
    low, high = height.min() - LEVEL_MARGIN, height.max() + LEVEL_MARGIN
    return float(low + fill_fraction * (high - low))
