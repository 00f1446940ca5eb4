"""The sparse factor against dense algebra: every precision and number of right-hand sides."""

import numpy as np
import pytest
import scipy.sparse as sp
from boxes import base_held, box, hold

from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.effects import Elasticity, Held, Slide
from sim.linalg.multifrontal import FactorSettings, SparseFactor, find_moved_nodes
from sim.runtime.device import Precision, find_device

CELLS = (6, 6, 6)
FEW, STRIP = FactorSettings().max_separate_sweeps, FactorSettings().strip_size
EXACT = {"float32": 2e-5, "float64": 1e-12}


def sliding() -> Anatomy:
    """A block on a held base whose sides slide: nodes of three, two and one unknowns."""
    mesh = box(CELLS, 0.1, distortion=0.15)
    base = mesh.nodes[:, 2] < 1e-9
    normal = np.zeros((len(mesh.nodes), 3))
    normal[mesh.nodes[:, 0] < 1e-9] = [0.6, 0.0, 0.8]
    return hold(mesh, base, np.where(base[:, None], 0.0, normal))


def system(anatomy: Anatomy) -> tuple[sp.csc_array, sp.csc_array]:
    """Stiffness at rest and free motions."""
    problem = compile_problem([Elasticity(), Held(), Slide()], anatomy, find_device("cpu", "float64"))
    return problem.rest_curvature(), problem.constraint.build_basis()


def applied(factor: SparseFactor, r: np.ndarray, precision: Precision, live: np.ndarray | None = None) -> np.ndarray:
    device = find_device("cpu", precision)
    out = device.allocate(*r.shape)
    factor.apply(device.upload(r), np.ones(r.shape[1], bool) if live is None else live, out)
    return out.numpy()


@pytest.mark.parametrize("precision", EXACT)
def test_factor_equals_inverse_on_free_dofs(precision: Precision) -> None:
    stiffness, motions = system(sliding())
    factor = SparseFactor(stiffness, motions, find_moved_nodes(motions), find_device("cpu", precision), precision)
    L, r = motions.toarray(), np.random.default_rng(0).normal(size=(stiffness.shape[0], FEW + 2))
    expected = L @ np.linalg.solve(L.T @ stiffness @ L, L.T @ r)
    for columns in (1, FEW, FEW + 2):  # sweeps, and products of matrices
        found = applied(factor, r[:, :columns], precision)
        error = np.linalg.norm(found - expected[:, :columns], axis=0) / np.linalg.norm(expected[:, :columns], axis=0)
        assert (error < EXACT[precision]).all()


@pytest.mark.parametrize("precision", EXACT)
def test_compliance_agrees_with_solutions_of_unit_forces(precision: Precision) -> None:
    stiffness, motions = system(sliding())
    factor = SparseFactor(stiffness, motions, find_moved_nodes(motions), find_device("cpu", precision), precision)
    rows = np.random.default_rng(1).choice(stiffness.shape[0], 2 * STRIP + 7, replace=False)
    unit = np.zeros((stiffness.shape[0], len(rows)))
    unit[rows, np.arange(len(rows))] = 1.0
    expected = applied(factor, unit, precision)[rows]
    np.testing.assert_allclose(
        factor.compute_compliance(rows), expected, atol=EXACT[precision] * np.abs(expected).max()
    )
    assert factor.compute_compliance(rows[:0]).shape == (0, 0)


@pytest.mark.parametrize("columns", [FEW, FEW + 2])
def test_factor_is_symmetric_in_single_precision(columns: int) -> None:
    """Conjugate gradients require it of every preconditioner, to round-off."""
    stiffness, motions = system(sliding())
    factor = SparseFactor(stiffness, motions, find_moved_nodes(motions), find_device("cpu", "float32"))
    r = np.random.default_rng(1).normal(size=(stiffness.shape[0], columns))
    gram = r.T @ applied(factor, r, "float32")
    np.testing.assert_allclose(gram, gram.T, atol=1e-6 * np.abs(gram).max())


@pytest.mark.parametrize("count", [2, FEW + 3])
def test_factor_solves_selected_columns(count: int) -> None:
    stiffness, motions = system(sliding())
    factor = SparseFactor(stiffness, motions, find_moved_nodes(motions), find_device("cpu", "float64"), "float64")
    r = np.random.default_rng(2).normal(size=(stiffness.shape[0], count))
    live = np.arange(count) != 1
    found, whole = applied(factor, r, "float64", live), applied(factor, r, "float64")
    np.testing.assert_allclose(found[:, live], whole[:, live], rtol=1e-12, atol=1e-12 * np.abs(whole).max())
    assert np.isfinite(found).all()


@pytest.mark.parametrize("columns", [1, FEW + 1])
def test_single_precision_factor_solves_forces_of_any_size(columns: int) -> None:
    """In a double-precision solver; a column without forces stays zero. Rounding depends on the processor."""
    stiffness, motions = system(sliding())
    factor = SparseFactor(stiffness, motions, find_moved_nodes(motions), find_device("cpu", "float64"))
    r = np.random.default_rng(4).normal(size=(stiffness.shape[0], columns)) * 10.0 ** (-60 * np.arange(1, columns + 1))
    r[:, 1:2] = 0.0
    found = motions.T @ stiffness @ applied(factor, r, "float64")
    expected = motions.T @ r
    assert (np.linalg.norm(found - expected, axis=0) <= 1e-4 * np.linalg.norm(expected, axis=0)).all()


def test_single_precision_factor_is_positive_definite() -> None:
    """Condition number beyond single precision: springs between neighbours, every third one 1e10 times stiffer."""
    stiff = np.where(np.arange(299) % 3 == 0, 1e10, 1.0)
    diagonal = np.append(stiff, 0.0) + np.append(1.0, stiff)
    matrix = sp.csc_array(sp.diags_array([-stiff, diagonal, -stiff], offsets=[-1, 0, 1]))
    factor = SparseFactor(matrix, sp.csc_array(sp.eye_array(300)), np.arange(300), find_device("cpu", "float64"))
    gram = applied(factor, np.eye(300), "float64")
    assert np.linalg.eigvalsh(gram / np.abs(gram).max())[0] > -1e-7


def test_factor_solves_disconnected_blocks() -> None:
    matrix = sp.csc_array(sp.block_diag([np.array([[2.0, -1.0], [-1.0, 2.0]])] * 200))
    factor = SparseFactor(
        matrix, sp.csc_array(sp.eye_array(400)), np.arange(400), find_device("cpu", "float64"), "float64"
    )
    r = np.random.default_rng(3).normal(size=(400, 1))
    np.testing.assert_allclose(matrix @ applied(factor, r, "float64"), r, rtol=1e-12)


def test_factor_of_one_or_no_unknown_is_exact() -> None:
    one = SparseFactor(sp.csc_array([[4.0]]), sp.csc_array([[1.0]]), np.zeros(1, int), find_device("cpu", "float64"))
    assert applied(one, np.array([[2.0, 6.0]]), "float64").tolist() == [[0.5, 1.5]]
    none = SparseFactor(sp.csc_array(np.eye(3)), sp.csc_array((3, 0)), np.zeros(0, int), find_device("cpu", "float64"))
    for columns in (1, FEW + 1):
        assert not applied(none, np.ones((3, columns)), "float64").any()


def test_singular_stiffness_is_rejected() -> None:
    """Rigid motions have no stiffness; neither has a node without elements."""
    anatomy = base_held(box(CELLS, 0.1, distortion=0.15))
    stiffness, _ = system(anatomy)
    every = sp.csc_array(sp.eye_array(stiffness.shape[0]))
    with pytest.raises(RuntimeError, match="positive definite"):
        SparseFactor(stiffness, every, find_moved_nodes(every), find_device("cpu", "float32"))
    with pytest.raises(RuntimeError, match="positive definite"):
        SparseFactor(sp.csc_array(-stiffness), every, find_moved_nodes(every), find_device("cpu", "float64"))
    nothing = sp.csc_array((3, 3))
    with pytest.raises(RuntimeError, match="positive definite"):
        SparseFactor(nothing, sp.csc_array(sp.eye_array(3)), np.zeros(3, int), find_device("cpu", "float64"))
