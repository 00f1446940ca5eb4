"""Cameras with their projection, lens distortion and calibration files."""
