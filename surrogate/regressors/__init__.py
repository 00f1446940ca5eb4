"""One file per regressor: features in, coefficients out."""
