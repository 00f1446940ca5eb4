"""Inverse of a field outside the tetrahedra."""

import numpy as np

from sim.fields.grid import Grid
from sim.fields.inversion import invert_field


def test_twist_beyond_fixed_point_iteration_is_inverted():
    """The iteration d = -u(y + d) alone diverges where the rotation or shear is this large."""
    grid = Grid(np.full(3, -20e-3), 1e-3, (41, 41, 41))
    x, y, _ = np.indices(grid.shape) * 1e-3 - 20e-3
    turn = 1.3 * np.exp(-(np.hypot(x, y) ** 2) / 7e-3**2)
    field = np.zeros((3, *grid.shape), np.float32)
    field[0] = x * np.cos(turn) - y * np.sin(turn) - x
    field[1] = x * np.sin(turn) + y * np.cos(turn) - y
    points = 1e-3 * np.random.default_rng(0).uniform(-9.0, 9.0, (300, 3))
    found = invert_field(grid, field, points, np.zeros_like(points))
    assert np.abs(found + grid.interpolate(field, points + found)).max() < 2e-6
