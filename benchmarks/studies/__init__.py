"""Measurements, and the rows that they print."""
