"""Newton-CG, L-BFGS, line search, residuals and power series: they know no particular term."""
