"""Smooth motions by forces in an infinite elastic body: an estimator that knows nothing of a brain but its tissue."""

import numpy as np

from sim.material import BRAIN

# Radius over which a force is spread [m].
SPREAD = 10e-3


def kelvinlets(at: np.ndarray, points: np.ndarray, spread: float = SPREAD) -> np.ndarray:
    """Motions (n, 3, V, 3) at places `at` (V, 3) [m] by unit forces along each axis at points (n, 3) [m].

    Regularised Kelvinlets, of the recommended brain's Poisson's ratio, times 4 pi mu: inverse lengths [1/m].

        ((1 - b) / r_e + e^2 / (2 r_e^3)) I + b / r_e^3 r r^T,  r_e^2 = r^2 + e^2,  b = 1 / (4 - 4 nu)

    De Goes, James 2017, "Regularized Kelvinlets", ACM Trans. Graph. 36:40, equation 6.
    """
    arm = at - points[:, None]
    length = np.sqrt((arm**2).sum(axis=2) + spread**2)[..., None, None]
    b = 1.0 / (4.0 * (1.0 - BRAIN.poisson))
    along = arm[..., :, None] * arm[..., None, :]
    block = ((1.0 - b) / length + spread**2 / (2.0 * length**3)) * np.eye(3) + b * along / length**3
    return block.transpose(0, 2, 1, 3)
