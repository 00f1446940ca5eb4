"""Errors of models relative to FEM, and the empirical coverage of their bounds."""
