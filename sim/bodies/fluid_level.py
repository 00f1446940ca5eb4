"""How high the fluid round a brain stands, as a share of the brain's height."""

import numpy as np

# Fluid of a full skull stands so far over the highest vertex, and of a drained one under the lowest [m].
SPARE = 1e-3


def compute_fluid_level(nodes: np.ndarray, down: np.ndarray, share: float) -> float:
    """Return the level [m] above the origin, against `down` (3,), a unit vector, round a body of nodes (V, 3) [m].

    `share` is from 0, wholly drained, to 1, over the highest vertex.
    """
    height = -nodes @ down
    low, high = height.min() - SPARE, height.max() + SPARE
    return float(low + share * (high - low))
