"""Block inverse and block elimination against dense algebra, on the host: torch multiplies as on a GPU."""

import numpy as np
import pytest
import scipy.sparse as sp

from sim.linalg import block_inverse

COUNT, BORDER = 23, 7
RANDOM = np.random.default_rng(0)
ROOT = RANDOM.normal(size=(COUNT, COUNT)) * (RANDOM.random((COUNT, COUNT)) < 0.3)
MATRIX = ROOT @ ROOT.T + np.eye(COUNT)
ACROSS = RANDOM.normal(size=(COUNT, BORDER))


@pytest.mark.parametrize("block", [1, 5, 23, 100])
def test_in_place_block_inverse_agrees_with_dense_inverse(block: int) -> None:
    rows = block_inverse.to_lower_block_rows(
        sp.csc_array(MATRIX), block_inverse.compute_block_bounds(COUNT, block), "cpu"
    )
    assert len(rows) == -(-COUNT // block)
    block_inverse.invert_in_place(rows)
    expected, first = -np.linalg.inv(MATRIX), 0
    for row in rows:
        stop = first + len(row)
        np.testing.assert_allclose(row.numpy(), expected[first:stop, :stop], atol=1e-12)
        first = stop
    assert first == COUNT


@pytest.mark.parametrize("block", [1, 5, 23, 100])
def test_block_elimination_agrees_with_dense_schur_complement(block: int) -> None:
    solution, taken = block_inverse.eliminate_unknowns(sp.csc_array(MATRIX), sp.csc_array(ACROSS), "cpu", block)
    expected = np.linalg.solve(MATRIX, ACROSS)
    assert solution.dtype == np.float32
    np.testing.assert_allclose(solution, expected, atol=1e-6)
    np.testing.assert_allclose(taken, ACROSS.T @ expected, atol=1e-12)


def test_block_elimination_rejects_indefinite_matrix() -> None:
    matrix = sp.csc_array(MATRIX - 1e3 * np.eye(COUNT))
    with pytest.raises(RuntimeError, match="positive"):
        block_inverse.eliminate_unknowns(matrix, sp.csc_array(ACROSS), "cpu")


def test_measured_multiplication_rate_is_positive() -> None:
    assert block_inverse.measure_matmul_rate("cpu", size=8) > 0.0
