"""Iterated conditioning: points without an undeformed position are matched to the estimated surface.

The closest points are recomputed in each iteration, as in Besl, McKay 1992, "A method for registration of 3-D shapes",
IEEE Trans. Pattern Anal. Mach. Intell. 14:239-256.
"""

import numpy as np

from .observation import Observation, to_deformed_evidence, to_evidence
from .posterior import Posterior, condition_prior
from .prior import MotionPrior

MAX_ITERATIONS = 6  # Maximum number of iterations of the posterior.
CENTROID_TOLERANCE = 0.2e-3  # Motion of the tumour's centroid below which the iteration ends [m].


def match_and_update(
    prior: MotionPrior, observation: Observation, allow_slip: bool = False
) -> tuple[Posterior, np.ndarray]:
    """Compute the posterior of an observation; return it and the indices (k,) of the used points, near the cortex.

    If `allow_slip`, the rigid error may be that of a slipped registration, see `condition_prior`.

    Raises
    ------
    InputError
        See `to_evidence` and `condition_prior`.
    """
    anatomy, tips, count = prior.anatomy, observation.tips, len(observation.now)
    evidence = to_evidence(anatomy, observation)
    near = np.unique(evidence.point[evidence.point < count])
    found = condition_prior(prior, evidence, tips, allow_slip)
    if observation.rest is None or len(tips):
        cortex, motion = np.unique(anatomy.open_surface), np.zeros_like(anatomy.mesh.nodes)
        for _ in range(MAX_ITERATIONS):
            motion[cortex] = np.tensordot(found.shape_weights, prior.restrict_shapes(cortex), 1)
            evidence = to_deformed_evidence(anatomy, observation, near, motion, found.compute_bias)
            supported = np.delete(np.arange(len(tips)), found.outliers[found.outliers >= count] - count)
            before, found = found, condition_prior(prior, evidence, tips[supported], allow_slip)
            if (
                np.linalg.norm((found.shape_weights - before.shape_weights) @ prior.centroid_motion)
                < CENTROID_TOLERANCE
            ):
                break
    return found, near
