"""Nodes moved and tetrahedra taken away for the sake of shape, without harm to what is represented."""

import numpy as np
import pytest

from sim.bodies.bcc_lattice import graded_lattice
from sim.bodies.isosurface_stuffing import cut, whole
from sim.bodies.manifold_repair import clean, ears
from sim.bodies.mesh_smoothing import Smoothing, enclosed_volume, fitted, improved, smallest_sines, unfolded
from sim.bodies.signed_distance import onto_level
from sim.geometry.tetmesh import dihedral_angles, faces_once, row_keys, signed_volumes

RADIUS = 0.03


def ball(points):
    return np.linalg.norm(points, axis=1) - RADIUS


@pytest.fixture(scope="module")
def body():
    lattice = graded_lattice(np.full(3, -0.04), np.full(3, 0.04), 0.008, 0, np.zeros_like)
    made = cut(whole(lattice), ball)
    return made.kept(made.inside)


def test_smallest_sine_is_that_of_the_dihedral_angles(body):
    angles = dihedral_angles(body.nodes, body.tets)
    np.testing.assert_allclose(
        smallest_sines(body.nodes[body.tets]), np.sin(np.radians(angles)).min(axis=1), rtol=1e-9, atol=1e-12
    )
    assert (smallest_sines(body.nodes[body.tets[:, [0, 1, 3, 2]]]) < 0.0).all()


def test_fitting_brings_the_surface_nearer_and_encloses_the_volume(body):
    triangles = faces_once(body.tets)
    movable = np.ones(len(body.nodes), bool)
    volume = 4 / 3 * np.pi * RADIUS**3
    moved = fitted(body.nodes, triangles, ball, movable, volume)
    assert enclosed_volume(moved, triangles) == pytest.approx(volume, rel=1e-3)
    assert enclosed_volume(body.nodes, triangles) < 0.985 * volume

    def distance(nodes):
        return np.abs(ball(np.concatenate([nodes[triangles].mean(axis=1), nodes[np.unique(triangles)]]))).mean()

    assert distance(moved) < 0.65 * distance(body.nodes)
    still = fitted(body.nodes, triangles, ball, ~movable, volume)
    np.testing.assert_array_equal(still, body.nodes)


def test_nodes_whose_move_turns_a_tetrahedron_inside_out_stay(body):
    inner = np.setdiff1d(np.arange(len(body.nodes)), faces_once(body.tets))
    thrown, pushed = inner[0], np.setdiff1d(inner, body.tets[(body.tets == inner[0]).any(axis=1)])[0]
    moved = body.nodes.copy()
    moved[thrown] += 0.02
    moved[pushed] += 1e-4
    assert signed_volumes(moved, body.tets).min() < 0.0
    kept = unfolded(body.nodes, moved, body.tets)
    assert signed_volumes(kept, body.tets).min() > 0.0
    np.testing.assert_array_equal(kept[thrown], body.nodes[thrown])
    np.testing.assert_array_equal(kept[pushed], moved[pushed])


def test_where_a_field_is_flat_nodes_do_not_fly_away():
    """Its slope there is round-off."""
    points = np.random.default_rng(0).normal(scale=0.01, size=(20, 3))
    moved = onto_level(lambda at: 2e-3 + 1e-6 * at[:, 0], points, np.zeros(20))
    assert np.abs(moved - points).max() < 1e-6
    steep = onto_level(lambda at: 0.2 * at[:, 0], points, np.zeros(20))
    np.testing.assert_allclose(steep[:, 0], 0.0, atol=1e-9)


def test_bad_angles_improve_and_surface_nodes_stay_on_the_surface(body):
    rng = np.random.default_rng(1)
    surface = np.zeros(len(body.nodes), bool)
    surface[faces_once(body.tets)] = True
    nodes = body.nodes + rng.normal(scale=1.2e-3, size=body.nodes.shape)
    level = np.zeros(len(nodes))

    def project(points, of):
        placed = points.copy()
        placed[surface[of]] = onto_level(ball, placed[surface[of]], level[of[surface[of]]])
        return placed

    nodes = project(nodes, np.arange(len(nodes)))
    moved = improved(nodes, body.tets, project)
    np.testing.assert_array_equal(improved(nodes, body.tets, project, Smoothing(rounds=0)), nodes)
    assert smallest_sines(nodes[body.tets]).min() < np.sin(np.radians(5.0))
    assert smallest_sines(moved[body.tets]).min() > np.sin(np.radians(14.0))
    assert np.abs(ball(moved[surface])).max() < 1e-6
    assert signed_volumes(moved, body.tets).min() > 0.0


def test_bodies_that_touch_in_an_edge_or_a_node_are_parted():
    lattice = graded_lattice(np.zeros(3), np.ones(3), 0.25, 0, np.zeros_like)
    middle = lattice.nodes[lattice.tets].mean(axis=1) - 0.5
    for together in ((middle[:, :2] > 0).all(axis=1) | (middle[:, :2] < 0).all(axis=1), (middle > 0).all(axis=1)):
        other = together | (middle < 0).all(axis=1)
        tets = lattice.tets[other]
        kept = tets[clean(tets)]
        assert 0.2 * len(tets) < len(kept) < len(tets)
        edges = faces_once(kept)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        assert set(np.unique(row_keys(edges), return_counts=True)[1]) == {2}
    assert clean(lattice.tets).all()


def test_taking_ears_leaves_a_manifold(body):
    rough = body.tets[np.linalg.norm(body.nodes[body.tets].mean(axis=1), axis=1) < 0.7 * RADIUS]
    rough = rough[clean(rough)]
    everywhere = np.ones(len(rough), bool)
    gone = ears(rough, everywhere)
    assert gone.any()
    assert clean(rough[~gone]).all()
    assert not ears(rough, ~everywhere).any()
