"""Rendering of surfaces to lit images."""
