"""PARDISO for symmetric matrices, as FElupe's how-to on external solvers gives it; one instance, for it opens MKL."""

import numpy as np
import scipy.sparse as sp
from pypardiso import PyPardisoSolver

PARDISO = PyPardisoSolver(mtype=-2)


def solve(matrix: sp.spmatrix, right: np.ndarray) -> np.ndarray:
    """The solution (n,) of a symmetric system; only its upper triangle is read."""
    return PARDISO.solve(sp.triu(matrix, format="csr"), right).squeeze()
