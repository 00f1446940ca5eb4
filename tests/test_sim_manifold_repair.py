"""Removal of tetrahedra until the surface is a manifold."""

import numpy as np

from sim.bodies.bcc_lattice import build_graded_lattice
from sim.bodies.manifold_repair import select_manifold
from sim.geometry.tetmesh import compute_row_keys, find_boundary_faces


def test_bodies_that_share_only_an_edge_or_node_are_separated():
    lattice = build_graded_lattice(np.zeros(3), np.ones(3), 0.25, 0, np.zeros_like)
    middle = lattice.nodes[lattice.tets].mean(axis=1) - 0.5
    for together in ((middle[:, :2] > 0).all(axis=1) | (middle[:, :2] < 0).all(axis=1), (middle > 0).all(axis=1)):
        other = together | (middle < 0).all(axis=1)
        tets = lattice.tets[other]
        kept = tets[select_manifold(tets)]
        assert 0.2 * len(tets) < len(kept) < len(tets)
        edges = find_boundary_faces(kept)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        assert set(np.unique(compute_row_keys(edges), return_counts=True)[1]) == {2}
    assert select_manifold(lattice.tets).all()
