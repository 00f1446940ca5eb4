"""Displacement fields on regular grids: interpolation in a mesh, smooth extension around the mesh, and inversion."""
