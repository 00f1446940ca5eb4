"""Tetrahedral meshes and triangulated surfaces, implemented in NumPy."""
