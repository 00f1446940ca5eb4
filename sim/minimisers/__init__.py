"""Minimisers for any terms: Newton-CG, L-BFGS, line search, residuals and power series."""
