"""Bodies cut from a lattice: angles, volumes, conformity, and nodes that keep their position."""

import numpy as np
import pytest

from sim.bodies.bcc_lattice import build_graded_lattice
from sim.bodies.isosurface_stuffing import IsosurfaceStuffingOptions, build_uncut_mesh, cut_mesh
from sim.geometry.tetmesh import compute_dihedral_angles, compute_row_keys, compute_signed_volumes, find_boundary_faces

RADIUS, INNER, MIDDLE = 0.06, 0.015, np.array([0.02, 0.01, 0.0])


def ball(points):
    return np.linalg.norm(points, axis=1) - RADIUS


def core(points):
    return np.linalg.norm(points - MIDDLE, axis=1) - INNER


@pytest.fixture(scope="module")
def carved():
    lattice = build_graded_lattice(np.full(3, -0.075), np.full(3, 0.075), 0.008, 0, np.zeros_like)
    body = cut_mesh(build_uncut_mesh(lattice), ball)
    body = body.select(body.is_inside)
    return body, cut_mesh(body, core, fixed_nodes=body.is_on_surface)


def test_dihedral_angles_meet_bound_of_isosurface_stuffing(carved):
    assert compute_dihedral_angles(carved[0].nodes, carved[0].tets).min() > 10.7


def test_both_materials_are_closed_and_fill_the_body(carved):
    body, both = carved
    assert compute_signed_volumes(both.nodes, both.tets).min() > 0.0
    for tets, volume in ((both.tets, 4 / 3 * np.pi * RADIUS**3), (both.tets[both.is_inside], 4 / 3 * np.pi * INNER**3)):
        edges = find_boundary_faces(tets)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        assert set(np.unique(compute_row_keys(edges), return_counts=True)[1]) == {2}
        assert compute_signed_volumes(both.nodes, tets).sum() == pytest.approx(volume, rel=0.1)
    assert compute_signed_volumes(both.nodes, both.tets).sum() == pytest.approx(
        compute_signed_volumes(body.nodes, body.tets).sum(), rel=1e-12
    )


def test_surface_nodes_lie_on_the_surface(carved):
    body, both = carved
    assert np.abs(ball(body.nodes[np.unique(find_boundary_faces(body.tets))])).max() < 1e-8
    assert np.abs(core(both.nodes[np.unique(find_boundary_faces(both.tets[both.is_inside]))])).max() < 1e-8


def test_no_tetrahedron_crosses_the_interface(carved):
    both = carved[1]
    values = core(both.nodes)[both.tets]
    assert values[both.is_inside].max() < 1e-8
    assert values[~both.is_inside].min() > -1e-8


def test_pinned_nodes_keep_their_position():
    lattice = build_graded_lattice(np.full(3, -0.075), np.full(3, 0.075), 0.008, 0, np.zeros_like)
    body = cut_mesh(build_uncut_mesh(lattice), ball)
    body = body.select(body.is_inside)

    def half(points):
        return points[:, 0] - 0.0013

    both = cut_mesh(body, half, fixed_nodes=body.is_on_surface)
    np.testing.assert_array_equal(both.nodes[: len(body.nodes)][body.is_on_surface], body.nodes[body.is_on_surface])
    assert not np.array_equal(both.nodes[: len(body.nodes)], body.nodes)


def test_zero_snap_distance_leaves_lattice_nodes_in_place():
    lattice = build_graded_lattice(np.full(3, -0.075), np.full(3, 0.075), 0.008, 0, np.zeros_like)
    body = cut_mesh(build_uncut_mesh(lattice), ball, settings=IsosurfaceStuffingOptions(max_snap_fraction=0.0))
    np.testing.assert_array_equal(body.nodes[: len(lattice.nodes)], lattice.nodes)


def test_isosurface_stuffing_is_deterministic(carved):
    body, both = carved
    again = cut_mesh(body, core, fixed_nodes=body.is_on_surface)
    np.testing.assert_array_equal(again.nodes, both.nodes)
    np.testing.assert_array_equal(again.tets, both.tets)
