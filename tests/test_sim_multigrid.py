"""Two levels against dense algebra: symmetric, positive definite, spectrally close to the inverse on every mesh."""

import numpy as np
import pytest
import scipy.sparse as sp
from boxes import box, hold, quadratic

from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.space import discretise
from sim.effects import Elasticity, Held, Slide
from sim.linalg.multigrid import TwoLevelCycle
from sim.linalg.pcg import BlockJacobi, Preconditioner
from sim.linalg.preconditioner import Preconditioning, choose_preconditioner, explain_factor_failure
from sim.material import Material
from sim.runtime.device import Precision, find_device

# Smoothed strains take two levels here, as on large meshes.
SMALL = Preconditioning(max_smoothed_factorised=0)


def body(kind: str, cells: tuple[int, int, int]) -> Anatomy:
    """A block whose base is held and whose sides slide; tetra10 brings mid-edge nodes beside their edges."""
    mesh = box(cells, 0.1, distortion=0.1)
    if kind == "tetra10":
        mesh = quadratic(mesh, curved=0.04)
    base, side = mesh.nodes[:, 2] < 1e-9, mesh.nodes[:, 0] < 1e-9
    return hold(mesh, base, np.where((side & ~base)[:, None], [1.0, 0.0, 0.0], 0.0))


def built(
    kind: str,
    poisson: float,
    cells: tuple[int, int, int],
    precision: Precision = "float64",
    settings: Preconditioning = SMALL,
) -> tuple[Problem, Preconditioner]:
    anatomy, device = body(kind, cells), find_device("cpu", precision)
    effects = Elasticity(Material("linear", 3000.0, poisson)), Held(), Slide()
    space = discretise(anatomy.mesh, "p2" if kind == "tetra10" else kind)
    problem = compile_problem(effects, anatomy, device, space)

    def unsmoothed(step: float) -> sp.csc_array:
        return compile_problem(effects, anatomy, device, discretise(anatomy.mesh, "p1")).rest_curvature(step)

    return problem, choose_preconditioner(problem, space, unsmoothed, settings=settings)


def matrices(problem: Problem, preconditioner: Preconditioner) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and preconditioner (n, n) over the free motions, scaled to ones on the stiffness's diagonal."""
    basis = problem.constraint.build_basis()
    K = (basis.T @ problem.rest_curvature() @ basis).toarray()
    problem.linearise(problem.device.allocate(problem.rows, basis.shape[1]), np.zeros(basis.shape[1], bool))
    preconditioner.prepare(problem, basis.shape[1])
    out = problem.device.allocate(problem.rows, basis.shape[1])
    preconditioner.apply(problem.device.upload(basis.toarray()), np.ones(basis.shape[1], bool), out)
    scale = np.sqrt(np.diag(K))
    return K / np.outer(scale, scale), basis.T @ out.numpy() * np.outer(scale, scale)


def spread(K: np.ndarray, M: np.ndarray) -> float:
    """Largest over smallest eigenvalue of M K, those of C^T M C with K = C C^T."""
    C = np.linalg.cholesky(K)
    values = np.linalg.eigvalsh(C.T @ M @ C)
    return float(values[-1] / values[0])


@pytest.mark.parametrize("poisson", [0.3, 0.49])
@pytest.mark.parametrize("kind", ["p2", "tetra10", "smoothed"])
def test_two_level_is_symmetric_positive_and_close(kind: str, poisson: float) -> None:
    problem, preconditioner = built(kind, poisson, (2, 2, 3))
    assert isinstance(preconditioner, TwoLevelCycle)
    K, M = matrices(problem, preconditioner)
    assert np.abs(M - M.T).max() < 1e-6 * np.abs(M).max()  # the coarse factor is kept in single precision
    assert np.linalg.eigvalsh((M + M.T) / 2.0).min() > 0.0
    _, jacobi = matrices(problem, BlockJacobi(problem.device))
    assert spread(K, M) < spread(K, jacobi) / 10.0


@pytest.mark.parametrize("kind", ["p2", "smoothed"])
def test_two_level_condition_grows_little_under_refinement(kind: str) -> None:
    coarse, fine = (spread(*matrices(*built(kind, 0.45, (n, n, n)))) for n in (2, 3))
    assert fine < 1.5 * coarse


def test_smoothed_stiffness_is_at_most_linear_stiffness() -> None:
    """Linear tetrahedra are the coarse solver of smoothed ones: their stiffness is at least as large."""
    (smoothed, _), (linear, _) = (built(kind, 0.49, (2, 2, 3)) for kind in ("smoothed", "p1"))
    basis = linear.constraint.build_basis()
    gap = (basis.T @ (linear.rest_curvature() - smoothed.rest_curvature()) @ basis).toarray()
    values = np.linalg.eigvalsh(gap)
    assert values.min() > -1e-10 * values.max()
    assert values.max() > 0.1 * np.abs(smoothed.rest_curvature()).max()


@pytest.mark.parametrize("kind", ["p2", "smoothed"])
def test_converged_columns_do_not_change_live_ones(kind: str) -> None:
    """Live columns of a batch equal separate ones; single precision nearly agrees."""
    answers = {}
    for precision in ("float64", "float32"):
        problem, preconditioner = built(kind, 0.45, (2, 2, 3), precision)
        free = problem.constraint.build_basis()
        r = free @ np.random.default_rng(0).normal(size=(free.shape[1], 3))
        live, out = np.array([True, False, True]), problem.device.allocate(problem.rows, 3)
        preconditioner.apply(problem.device.upload(r), live, out)
        for column in np.flatnonzero(live):
            alone = problem.device.allocate(problem.rows, 1)
            preconditioner.apply(problem.device.upload(r[:, [column]]), np.ones(1, bool), alone)
            expected = alone.numpy()[:, 0]
            np.testing.assert_allclose(out.numpy()[:, column], expected, atol=1e-5 * np.abs(expected).max())
        answers[precision] = out.numpy()[:, live]
    np.testing.assert_allclose(*answers.values(), atol=1e-4 * np.abs(answers["float64"]).max())


def test_out_of_memory_and_free_body_have_separate_messages():
    full = RuntimeError("Failed to allocate 21322944 bytes on device 'cuda:0'")
    assert explain_factor_failure(full, "cuda:0").startswith(
        "cuda:0 has too little free memory for this mesh: end what else runs"
    )
    assert explain_factor_failure(RuntimeError("a pivot is 0"), "cpu").endswith(
        "(a pivot is 0): fix or support every part."
    )
