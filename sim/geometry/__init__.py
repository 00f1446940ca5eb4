"""Tetrahedral meshes and triangulated surfaces, in NumPy only."""
