"""Errors of models, and the empirical coverage of their bounds."""
