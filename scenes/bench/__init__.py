"""Measurements: one file for each word of `sulcus bench`."""
