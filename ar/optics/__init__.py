"""Cameras: projection, lenses, calibrations."""
