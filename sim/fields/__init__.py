"""Displacement fields on regular grids: interpolation in a body, smooth extension around it, and inversion."""
