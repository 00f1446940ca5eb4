"""Tetrahedral meshes and triangulated surfaces, in NumPy alone."""
