"""Estimation of a patient's tissue parameters from observations of the open cortex in several frames."""
