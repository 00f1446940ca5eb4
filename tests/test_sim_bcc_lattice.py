"""The graded lattice fills its box with well-shaped tetrahedra that fit each other."""

import numpy as np
import pytest

from sim.bodies.bcc_lattice import build_graded_lattice
from sim.geometry.tetmesh import (
    FACES,
    compute_dihedral_angles,
    compute_row_keys,
    compute_signed_volumes,
    find_boundary_faces,
)

MIDDLE = np.array([0.03, 0.02, 0.01])


def lattice(levels):
    def size(points):
        return 0.003 + 0.5 * np.abs(np.linalg.norm(points - MIDDLE, axis=1) - 0.02)

    return build_graded_lattice(np.full(3, -0.07), np.full(3, 0.07), 0.02, levels, size)


@pytest.mark.parametrize("levels", [0, 1, 2, 3])
def test_lattice_is_conforming_with_bounded_angles(levels):
    made = lattice(levels)
    assert compute_signed_volumes(made.nodes, made.tets).min() > 0.0
    angles = compute_dihedral_angles(made.nodes, made.tets)
    # BCC tetrahedra alone: 60 and 90 degrees; with changes of size, 45 to 120.
    assert angles.min() > (59.9 if levels == 0 else 44.9)
    assert angles.max() < (90.1 if levels == 0 else 120.1)
    _, count = np.unique(compute_row_keys(made.tets[:, FACES].reshape(-1, 3)), return_counts=True)
    assert count.max() == 2
    # Were two neighbours split differently, faces inside the box would be left over, and count as its surface.
    surface = find_boundary_faces(made.tets)
    corners = made.nodes[surface]
    enclosed = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert enclosed == pytest.approx(compute_signed_volumes(made.nodes, made.tets).sum(), rel=1e-12)
    edges = surface[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert set(np.unique(compute_row_keys(edges), return_counts=True)[1]) == {2}


def test_lattice_cell_size_follows_sizing_field():
    made = lattice(3)
    longest = np.linalg.norm(made.nodes[made.tets] - made.nodes[np.roll(made.tets, 1, axis=1)], axis=2).max(axis=1)
    away = np.abs(np.linalg.norm(made.nodes[made.tets].mean(axis=1) - MIDDLE, axis=1) - 0.02)
    assert longest[away < 0.002].max() < 0.25 * 1.01 * longest[away > 0.05].max()


def test_short_lattice_edges_join_centres_with_corners():
    made = lattice(0)
    ends = made.tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]]
    length = np.linalg.norm(np.diff(made.nodes[ends], axis=2)[:, :, 0], axis=2)
    mixed = made.is_centre[ends[..., 0]] != made.is_centre[ends[..., 1]]
    np.testing.assert_allclose(length[mixed], 0.02 * np.sqrt(0.75))
    np.testing.assert_allclose(length[~mixed], 0.02)
