"""Distances along surfaces against closed forms."""

import numpy as np

from sim.bodies.bcc_lattice import build_graded_lattice
from sim.bodies.isosurface_stuffing import build_uncut_mesh, cut_mesh
from sim.geometry.geodesic import compute_geodesic_distances
from sim.geometry.tetmesh import find_boundary_faces


def test_geodesic_distances_on_sphere_are_arcs():
    radius = 0.06
    lattice = build_graded_lattice(np.full(3, -0.075), np.full(3, 0.075), 0.008, 0, np.zeros_like)
    body = cut_mesh(build_uncut_mesh(lattice), lambda points: np.linalg.norm(points, axis=1) - radius)
    body = body.select(body.is_inside)
    surface = find_boundary_faces(body.tets)
    source = radius * np.array([0.6, 0.0, 0.8])
    found = compute_geodesic_distances(body.nodes, surface, source, 0.08)
    outer = np.unique(surface)
    arcs = radius * np.arccos(np.clip(body.nodes[outer] @ source / radius**2, -1.0, 1.0))
    near = arcs < 0.07
    np.testing.assert_allclose(found[outer][near], arcs[near], rtol=0.02, atol=2e-4)
    assert np.isinf(found[outer][arcs > 0.085]).all()
    assert np.isinf(np.delete(found, outer)).all()


def test_geodesic_distances_lead_round_a_gap():
    # A horseshoe in the plane: from one tip to the other the way leads round the slit.
    x, y = np.meshgrid(np.arange(11.0), np.arange(11.0), indexing="ij")
    nodes = np.stack([x.ravel(), y.ravel(), np.zeros(121)], axis=1) * 0.001
    number = np.arange(121).reshape(11, 11)
    cells = np.array([(i, j) for i in range(10) for j in range(10) if not (i == 5 and j < 9)])
    a, b = number[cells[:, 0], cells[:, 1]], number[cells[:, 0] + 1, cells[:, 1]]
    c, d = number[cells[:, 0] + 1, cells[:, 1] + 1], number[cells[:, 0], cells[:, 1] + 1]
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    found = compute_geodesic_distances(nodes, triangles, nodes[number[5, 0]], 0.1)
    exact = 0.009 + 0.001 + 0.009
    assert exact <= found[number[6, 0]] + 1e-12 < 1.02 * exact
