"""Measurements, and what they print as rows."""
