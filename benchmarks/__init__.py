"""Measurements of sulcus itself."""
