"""Estimation of a patient's tissue from observations of the open cortex in several frames."""
