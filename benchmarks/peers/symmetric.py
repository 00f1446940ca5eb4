"""PARDISO for symmetric matrices, after FElupe's how-to; matrices of one pattern share the symbolic analysis."""

import numpy as np
import scipy.sparse as sp
from pypardiso import PyPardisoSolver

ANALYSE, FACTORISE, SOLVE = 11, 22, 33


class Factor:
    """Factor of a symmetric matrix, of which only the upper triangle is read, in separate memory."""

    def __init__(self):
        self._pardiso = PyPardisoSolver(mtype=-2)
        self._upper = sp.csr_matrix((0, 0))

    def _call(self, phase: int, right: np.ndarray) -> np.ndarray:
        # `PyPardisoSolver.solve` would compare the matrix with the factorised one, which takes longer than the solve.
        self._pardiso.set_phase(phase)
        return self._pardiso._call_pardiso(self._upper, right)

    def factorise(self, matrix: sp.spmatrix) -> None:
        """Factorise a matrix (n, n); the symbolic analysis is reused if the pattern is that of the last one."""
        before, self._upper = self._upper, sp.csr_matrix(sp.triu(matrix, format="csr"))
        self._upper.sort_indices()
        nothing = np.zeros(self._upper.shape[0])
        same = before.shape == self._upper.shape and before.nnz == self._upper.nnz
        if not (same and (before.indptr == self._upper.indptr).all() and (before.indices == self._upper.indices).all()):
            self._call(ANALYSE, nothing)
        self._call(FACTORISE, nothing)

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve for a right-hand side (n,): (n,)."""
        return self._call(SOLVE, rhs)


KEPT = Factor()


def solve(matrix: sp.spmatrix, rhs: np.ndarray) -> np.ndarray:
    """Solve a symmetric system (n, n) for (n,), with one factor object for all calls."""
    KEPT.factorise(matrix)
    return KEPT.solve(np.ascontiguousarray(rhs, float).ravel())
