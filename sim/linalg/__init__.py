"""Conjugate gradients, factors, inverses, multigrid, and which of them preconditions a problem."""
