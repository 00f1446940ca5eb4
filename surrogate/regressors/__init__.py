"""Regressors, one per file: features in, coefficients out."""
