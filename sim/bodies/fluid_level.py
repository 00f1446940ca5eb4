"""Level of the fluid around a brain, from a fraction of the brain's height."""

import numpy as np

# Distance of the fluid level above the highest (full) or below the lowest (drained) vertex [m].
LEVEL_MARGIN = 1e-3


def compute_fluid_level(nodes: np.ndarray, down: np.ndarray, fill_fraction: float) -> float:
    """Return the fluid level [m] above the origin, measured against the unit vector `down` (3,), for nodes (V, 3) [m].

    `fill_fraction` ranges from 0 (drained, 1 mm below the lowest node) to 1 (full, 1 mm above the highest node).
    """
    height = -nodes @ down
    low, high = height.min() - LEVEL_MARGIN, height.max() + LEVEL_MARGIN
    return float(low + fill_fraction * (high - low))
