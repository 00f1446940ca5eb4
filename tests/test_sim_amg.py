"""Algebraic multigrid against dense algebra and under refinement, and the selection of the preconditioner."""

import numpy as np
import pytest
from boxes import base_held, box
from test_sim_multigrid import built, matrices, spread

from sim.compile import compile_problem
from sim.discretisation.space import discretise
from sim.effects import Elasticity, Held
from sim.linalg.amg import build_rigid_motions
from sim.linalg.pcg import BlockJacobi, solve_conjugate_gradients
from sim.linalg.preconditioner import Preconditioning, get_preconditioner_name
from sim.material import Material
from sim.runtime.device import find_device

# Every mesh is too large for a factor, and ten nodes are enough for the last level.
LEVELS = Preconditioning(max_factorised=0, max_smoothed_factorised=0, max_coarsest_nodes=10)


@pytest.mark.parametrize("poisson", [0.3, 0.49])
@pytest.mark.parametrize("kind", ["p1", "p2", "tetra10", "smoothed"])
def test_amg_is_symmetric_positive_and_spectrally_equivalent(kind: str, poisson: float) -> None:
    problem, preconditioner = built(kind, poisson, (3, 3, 4), settings=LEVELS)
    K, M = matrices(problem, preconditioner)
    assert np.abs(M - M.T).max() < 1e-6 * np.abs(M).max()  # the coarsest factor is kept in single precision
    assert np.linalg.eigvalsh((M + M.T) / 2.0).min() > 0.0
    assert spread(K, M) < (12.0 if poisson == 0.3 else 150.0)


def test_amg_iterations_grow_little_under_refinement() -> None:
    """Eight times as many unknowns and one level more; block Jacobi would take twice the iterations."""
    count = []
    for cells in (4, 8):
        problem, preconditioner = built("p1", 0.45, (cells, cells, cells), settings=LEVELS)
        free, device = problem.constraint.build_basis(), problem.device
        r = free @ np.random.default_rng(0).normal(size=(len(free.indptr) - 1, 2))
        problem.linearise(device.allocate(*r.shape), np.zeros(2, bool))
        preconditioner.prepare(problem, 2)
        tolerance = 1e-6 * np.linalg.norm(r, axis=0)
        count.append(solve_conjugate_gradients(problem, preconditioner, device.upload(r), tolerance, 400).iterations)
    assert count[1] <= 25
    assert count[1] <= count[0] + 8


def test_amg_cycle_is_deterministic() -> None:
    first, second = (matrices(*built("p1", 0.45, (3, 3, 4), settings=LEVELS))[1] for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("kind", "largest", "name"),
    [
        ("p1", 10_000, "sparse factor"),
        ("p1", 0, "algebraic multigrid, 3 levels"),
        ("p2", 10_000, "p-multigrid on sparse factor"),
        ("p2", 0, "p-multigrid on algebraic multigrid, 3 levels"),
        ("smoothed", 10_000, "sparse factor"),
    ],
)
def test_preconditioner_is_selected_by_size_and_element(kind: str, largest: int, name: str) -> None:
    settings = Preconditioning(max_factorised=largest, max_coarsest_nodes=5)
    problem, preconditioner = built(kind, 0.45, (5, 5, 5), settings=settings)
    assert get_preconditioner_name(preconditioner) == name
    assert get_preconditioner_name(BlockJacobi(problem.device)) == "block Jacobi"


def test_rigid_motions_lie_in_kernel_of_rest_stiffness() -> None:
    anatomy = base_held(box((2, 2, 3), distortion=0.2))
    space, device = discretise(anatomy.mesh, "p1"), find_device("cpu", "float64")
    problem = compile_problem((Elasticity(Material("linear", 3000.0, 0.3)), Held()), anatomy, device, space)
    K, R = problem.rest_curvature(), build_rigid_motions(anatomy.mesh.nodes)
    assert np.linalg.matrix_rank(R) == 6
    assert np.abs(K @ R).max() < 1e-12 * np.abs(K).max() * np.abs(R).max()
