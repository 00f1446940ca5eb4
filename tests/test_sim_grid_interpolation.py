"""Values of vertices at the nodes of a grid."""

import numpy as np
import pytest
from test_sim_grid import bump

from sim.fields.grid import build_grid_around
from sim.fields.grid_interpolation import interpolate_in_tetrahedra
from sim.geometry.locate import locate


@pytest.fixture(scope="module")
def moved(box):
    return bump(box.mesh.nodes)


def test_grid_nodes_in_tetrahedra_interpolate_the_vertices(box, moved):
    grid = build_grid_around(box.mesh.nodes, 1.7e-3, 4e-3)
    field, inside = interpolate_in_tetrahedra(grid, box.mesh.nodes, box.mesh.tets, moved)
    points = grid.compute_positions(np.arange(inside.size))
    low, high = box.mesh.nodes.min(axis=0), box.mesh.nodes.max(axis=0)
    assert np.array_equal(inside.ravel(), ((points > low - 1e-9) & (points < high + 1e-9)).all(axis=1))
    some = np.flatnonzero(inside)[::37]
    expected = locate(box.mesh, points[some]).interpolate(moved[None])[0]
    assert np.abs(field.reshape(3, -1)[:, some].T - expected).max() < 1e-8
    assert not field[:, ~inside].any()


def test_every_grid_node_on_a_shared_face_is_inside():
    """A lattice with the grid's nodes: none is missed between two tetrahedra."""
    nodes = 1e-3 * np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4], [4, 4, 4]], float)
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    grid = build_grid_around(nodes, 1e-3, 0.0)
    inside = interpolate_in_tetrahedra(grid, nodes, tets, nodes)[1]
    points = 1e3 * grid.compute_positions(np.arange(inside.size))
    x, y, z = points.T
    first = x + y + z <= 4 + 1e-9
    second = (x + y + z >= 4 - 1e-9) & (x - y + z <= 4 + 1e-9) & (x + y - z <= 4 + 1e-9) & (-x + y + z <= 4 + 1e-9)
    assert np.array_equal(inside.ravel(), first | second)
