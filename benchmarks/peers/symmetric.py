"""PARDISO for symmetric matrices, as FElupe's how-to gives it; matrices of one pattern share its analysis."""

import numpy as np
import scipy.sparse as sp
from pypardiso import PyPardisoSolver

ANALYSE, FACTORISE, SOLVE = 11, 22, 33


class Factor:
    """The factor of a symmetric matrix of which only the upper triangle is read, in memory of its own."""

    def __init__(self):
        self._pardiso = PyPardisoSolver(mtype=-2)
        self._upper = sp.csr_matrix((0, 0))

    def _call(self, phase: int, right: np.ndarray) -> np.ndarray:
        # `PyPardisoSolver.solve` would compare the matrix with the factorised one, which costs more than to solve.
        self._pardiso.set_phase(phase)
        return self._pardiso._call_pardiso(self._upper, right)

    def renew(self, matrix: sp.spmatrix) -> None:
        """Factorise (n, n); the analysis stays where the pattern is the last one's."""
        before, self._upper = self._upper, sp.csr_matrix(sp.triu(matrix, format="csr"))
        self._upper.sort_indices()
        nothing = np.zeros(self._upper.shape[0])
        same = before.shape == self._upper.shape and before.nnz == self._upper.nnz
        if not (same and (before.indptr == self._upper.indptr).all() and (before.indices == self._upper.indices).all()):
            self._call(ANALYSE, nothing)
        self._call(FACTORISE, nothing)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (n,) for a right-hand side (n,)."""
        return self._call(SOLVE, right)


KEPT = Factor()


def solve(matrix: sp.spmatrix, right: np.ndarray) -> np.ndarray:
    """The solution (n,) of a symmetric system, by one factor for all."""
    KEPT.renew(matrix)
    return KEPT.solve(np.ascontiguousarray(right, float).ravel())
