"""The error of a prediction, estimated by the finite elements of the same mesh without a full solve.

The state where one step of the finite elements leads (`sim/strategy/newton_correction.py`) is much nearer to
equilibrium than the prediction. It is so much nearer that their distance is the prediction's error. The ratio of the
two is called the effectivity: Ainsworth, Oden 1997, "A posteriori error estimation in finite element analysis", Comput.
Methods Appl. Mech. Eng. 142:1-88. What is left after the step, as the rest stiffness has it, says how far that holds;
where too much is left, up to two more steps follow.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from sim.deformation import Cost, Deformation, guess, joined
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads

STEPS = 3
# An estimate is sound where no more than this share of it may still be missing, so that its effectivity is 0.8 to 1.25,
# as far as the rest stiffness can estimate it: with more than this relative residual it cannot.
SHARE, SETTLED = 0.2, 1e-2
SCOPE = (
    "this certifies against the finite elements on this mesh alone: not against a finer mesh, another tissue, or the "
    "patient"
)


@dataclass(frozen=True, eq=False)
class Certificate:
    """What the finite elements estimate of B predictions.

    Parameters
    ----------
    estimate
        (B,) [m]: the largest motion of the correction over the tumour's vertices.
    left
        (B,) [m]: the largest motion there that is still missing after it, as the rest stiffness has it.
    correction
        (B, n, 3) [m] at the prediction's vertices.
    corrected
        The answers after it, at every vertex; good where they are in equilibrium to the finite elements' tolerance.
    before, after
        (B,) relative residuals of what the steps began with and ended with.
    cost
        Seconds of all B: what is strained most settled, the linear solves, the searches along them, the rest.
    """

    estimate: np.ndarray
    left: np.ndarray
    correction: np.ndarray
    corrected: Deformation
    before: np.ndarray
    after: np.ndarray
    cost: Cost

    @property
    def sound(self) -> np.ndarray:
        """(B,) bool: so little is left that the estimate is the error."""
        return _sound(self.corrected, self.left, self.estimate)


def certify(fem: Fem, loads: Loads, prediction: Deformation) -> Certificate:
    """Estimate the error of predictions at the tumour, and correct them by one step, or up to three.

    A prediction at every vertex is itself where the steps begin. One that knows the tumour and less than all leaves
    that to the answer of the rest stiffness, which the step from rest finds first.

    Raises
    ------
    InputError
        Predictions of other loads or of another mesh, a mesh without tumour, loads that no effect answers.
    """
    begun = time.perf_counter()
    mesh, tumour = fem.anatomy.mesh, fem.anatomy.tumour_nodes
    _check(len(mesh.nodes), tumour, loads, prediction)
    every = len(prediction.nodes) == len(mesh.nodes)
    start = prediction if every else guess(np.zeros((len(loads), *mesh.nodes.shape)))
    predicted = prediction.at(tumour).displacement
    corrected, before, missing = fem.corrected(loads, start, tumour)
    left, seconds = largest(missing), dict(corrected.cost.seconds)
    for _ in range(STEPS - 1):
        estimate = largest(corrected.displacement[:, tumour] - predicted)
        again = np.flatnonzero(~_sound(corrected, left, estimate))
        if not len(again):
            break
        further, _, missing = fem.corrected(loads.rows(again), corrected.rows(again), tumour)
        lower = np.flatnonzero(further.residual < corrected.residual[again])
        rows, pick = again[lower], np.arange(len(loads))
        pick[rows] = len(loads) + lower
        steps = replace(further, iterations=corrected.iterations[again] + further.iterations)
        corrected, left[rows] = joined([corrected, steps]).rows(pick), largest(missing[lower])
        seconds = {stage: spent + further.cost.seconds[stage] for stage, spent in seconds.items()}
    correction = corrected.displacement[:, prediction.nodes] - prediction.displacement
    cost = Cost({**seconds, "rest": time.perf_counter() - begun - sum(seconds.values())})
    return Certificate(
        largest(corrected.displacement[:, tumour] - predicted),
        left,
        correction,
        replace(corrected, cost=cost),
        before,
        corrected.residual,
        cost,
    )


def _sound(corrected: Deformation, left: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    converged = np.array([outcome.good for outcome in corrected.outcome], bool)
    return converged | ((left <= SHARE * estimate) & (corrected.residual <= SETTLED))


def largest(motion: np.ndarray) -> np.ndarray:
    """The largest distance (B,) [m] of motions (B, n, 3) [m]."""
    return np.linalg.norm(motion, axis=2).max(axis=1)


def _check(vertices: int, tumour: np.ndarray, loads: Loads, prediction: Deformation) -> None:
    if not len(tumour):
        raise InputError("the anatomy has no tumour whose error could be estimated: make it with one.")
    if len(prediction) != len(loads):
        raise InputError(f"{len(prediction)} predictions do not answer {len(loads)} loads: give one for each.")
    if prediction.nodes.max(initial=-1) >= vertices or not np.isin(tumour, prediction.nodes).all():
        raise InputError(
            f"the prediction, of {len(prediction.nodes)} vertices, is of another mesh than the finite elements, which "
            f"have {vertices}, {len(tumour)} of them a tumour's. Take the anatomy that the model was trained on."
        )
