"""Newton-CG, L-BFGS, line search, residuals and power series, independent of particular terms."""
