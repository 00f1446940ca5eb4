"""Local solvers for tissue that is strongly strained or touched: nonlinear elimination and contact."""
