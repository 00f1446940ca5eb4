"""Regressors from features to coefficients, one type per file."""
