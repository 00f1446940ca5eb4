"""Linear solvers: conjugate gradients, factors, inverses and multigrid, and the choice of a preconditioner."""
