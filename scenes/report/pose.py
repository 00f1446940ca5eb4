"""Error of a model whose tool moves as in the reference; the force is adjusted to obtain this motion."""

from collections.abc import Callable

import numpy as np

from sim.discretisation.footprint import compute_footprint_weights
from sim.loads import Pushed

from .reference import get_reference
from .row import ErrorFigures, compare_with_reference
from .study import ReportStudy

Solve = Callable[[np.ndarray, np.ndarray], np.ndarray]
TOLERANCE = 1e-3  # Tolerance of a footprint's motion, relative to it.
MAX_SOLVES = 10  # Maximum number of solves of a load.
MAX_STEP_RATIO = 0.5  # Maximum change of a force in an iteration, relative to the force.


def measure_pose_error(study: ReportStudy, solve: Solve) -> ErrorFigures | None:
    """Compute errors at the tumour if each footprint's mean motion equals that in the reference.

    Returns None if no load converges. `solve(rows, force)` returns displacements (n, m, 3) [m] at `study.read_nodes`
    for the test loads with numbers `rows` (n,) under forces (n, 3) [N].
    """
    truth, mesh, (pushed,) = get_reference(study), study.anatomy.mesh, study.test_loads.get_all(Pushed)
    weights = compute_footprint_weights(mesh.nodes, mesh.surface, pushed.point, pushed.footprint)[:, study.read_nodes]
    weights = weights.toarray() / weights.sum(axis=1)[:, None]
    good = truth.good.copy()
    field = find_field_of_motion(solve, pushed.force, compute_motion(weights, truth.displacement), weights, good)
    nodes = study.anatomy.tumour_nodes
    return compare_with_reference(study, field[:, np.isin(study.read_nodes, nodes)], good, nodes)


def compute_motion(weights: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Compute the mean displacement (n, 3) [m] of footprints with weights (n, m), from displacements (n, m, 3) [m]."""
    return np.einsum("nm,nmi->ni", weights, field)


def find_field_of_motion(
    solve: Solve, force: np.ndarray, target: np.ndarray, weights: np.ndarray, good: np.ndarray
) -> np.ndarray:
    """Find displacements (n, m, 3) [m] in which footprints with `weights` (n, m) move by `target` (n, 3) [m].

    Broyden's "good" method (Broyden 1965) from each `force` (n, 3). `good` (n,): solved loads; False if not converged.
    """
    force, rows = force.copy(), np.flatnonzero(good)
    field = np.zeros((*weights.shape, 3))
    field[rows] = solve(rows, force[rows])
    motion = compute_motion(weights, field)
    ratio = np.linalg.norm(force, axis=1) / np.maximum(np.linalg.norm(motion, axis=1), 1e-12)
    inverse = ratio[:, None, None] * np.eye(3)
    for solves in range(1, MAX_SOLVES + 1):
        good &= np.isfinite(field).all(axis=(1, 2))
        reached = np.linalg.norm(target - motion, axis=1) <= TOLERANCE * np.linalg.norm(target, axis=1)
        rows = np.flatnonzero(good & ~reached)
        if not len(rows) or solves == MAX_SOLVES:
            break
        step = np.einsum("nij,nj->ni", inverse[rows], (target - motion)[rows])
        limit = MAX_STEP_RATIO * np.linalg.norm(force[rows], axis=1)
        step *= np.minimum(1.0, limit / np.linalg.norm(step, axis=1))[:, None]
        force[rows] += step
        field[rows] = solve(rows, force[rows])
        change = compute_motion(weights[rows], field[rows]) - motion[rows]
        motion[rows] += change
        image = np.einsum("nij,nj->ni", inverse[rows], change)
        row = np.einsum("ni,nij->nj", step, inverse[rows])
        scale = np.einsum("ni,ni->n", step, image)[:, None, None]
        inverse[rows] += (step - image)[:, :, None] * row[:, None, :] / np.where(scale == 0.0, np.inf, scale)
    good[rows] = False
    return field
