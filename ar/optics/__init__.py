"""Cameras: where points land in a picture, lenses, calibrations."""
