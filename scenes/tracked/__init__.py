"""Overlay on a real or rendered video; files of a real camera."""
