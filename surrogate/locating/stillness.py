"""Whether anything is seen to have moved, or what is seen is no more than its errors."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from .posterior import Posterior

# So improbable by errors alone is what is seen where something moved, by each of three tests.
MOVED = 0.005


def within_errors(posterior: Posterior) -> bool:
    """Whether what is seen is no more than its errors, the rigid one as large as is stated: nothing need have moved.

    Two tests are of its size: the square Mahalanobis distance has a part of what is rigid, by generalised least
    squares, and one of the rest. Both are chi-squared. The third is of its form: how many times as probable motions of
    the prior make it, by their mean evidence, as errors alone do. By Markov's inequality errors alone exceed 1 / p with
    a probability of p at most. So a dent is seen that is no larger in all than errors might be.
    """
    evidence = posterior.evidence
    whitening, scale = evidence.whitening(0.0), evidence.rigid_scale
    rigid, white = whitening.white(evidence.rigid * scale), whitening.white(evidence.value)
    precision, gain = rigid.T @ rigid, rigid.T @ white
    whole = np.eye(6) + precision
    found = np.linalg.lstsq(precision, gain, rcond=None)[0]
    together = found @ np.linalg.solve(whole, precision @ found)
    rest = ((white - rigid @ found) ** 2).sum()
    if min(chdtrc(6, together), chdtrc(len(white) - 6, rest)) <= MOVED:
        return False
    still = 0.5 * (gain @ np.linalg.solve(whole, gain) - np.linalg.slogdet(whole)[1] - white @ white)
    return bool(posterior.moving - still - whitening.logarithm < -np.log(MOVED))
