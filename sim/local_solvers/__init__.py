"""Local solvers for strongly strained or touched tissue: nonlinear elimination and contact."""
