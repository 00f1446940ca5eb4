"""Smoothing of nodes and removal of tetrahedra for better shapes, without change of the represented surface."""

import numpy as np
import pytest

from sim.bodies.bcc_lattice import build_graded_lattice
from sim.bodies.isosurface_stuffing import build_uncut_mesh, cut_mesh
from sim.bodies.manifold_repair import find_removable_tetrahedra, select_manifold
from sim.bodies.mesh_smoothing import (
    Smoothing,
    compute_enclosed_volume,
    compute_smallest_sines,
    fit_nodes,
    improve_mesh,
    prevent_folds,
)
from sim.bodies.signed_distance import project_onto_level
from sim.geometry.tetmesh import compute_dihedral_angles, compute_signed_volumes, find_boundary_faces

RADIUS = 0.03


def ball(points):
    return np.linalg.norm(points, axis=1) - RADIUS


@pytest.fixture(scope="module")
def body():
    lattice = build_graded_lattice(np.full(3, -0.04), np.full(3, 0.04), 0.008, 0, np.zeros_like)
    made = cut_mesh(build_uncut_mesh(lattice), ball)
    return made.select(made.is_inside)


def test_smallest_sine_is_that_of_the_dihedral_angles(body):
    angles = compute_dihedral_angles(body.nodes, body.tets)
    np.testing.assert_allclose(
        compute_smallest_sines(body.nodes[body.tets]), np.sin(np.radians(angles)).min(axis=1), rtol=1e-9, atol=1e-12
    )
    assert (compute_smallest_sines(body.nodes[body.tets[:, [0, 1, 3, 2]]]) < 0.0).all()


def test_surface_fit_reduces_distance_at_same_volume(body):
    triangles = find_boundary_faces(body.tets)
    movable = np.ones(len(body.nodes), bool)
    volume = 4 / 3 * np.pi * RADIUS**3
    moved = fit_nodes(body.nodes, triangles, ball, movable, volume)
    assert compute_enclosed_volume(moved, triangles) == pytest.approx(volume, rel=1e-3)
    assert compute_enclosed_volume(body.nodes, triangles) < 0.985 * volume

    def distance(nodes):
        return np.abs(ball(np.concatenate([nodes[triangles].mean(axis=1), nodes[np.unique(triangles)]]))).mean()

    assert distance(moved) < 0.65 * distance(body.nodes)
    still = fit_nodes(body.nodes, triangles, ball, ~movable, volume)
    np.testing.assert_array_equal(still, body.nodes)


def test_nodes_that_would_invert_a_tetrahedron_are_not_moved(body):
    inner = np.setdiff1d(np.arange(len(body.nodes)), find_boundary_faces(body.tets))
    thrown, pushed = inner[0], np.setdiff1d(inner, body.tets[(body.tets == inner[0]).any(axis=1)])[0]
    moved = body.nodes.copy()
    moved[thrown] += 0.02
    moved[pushed] += 1e-4
    assert compute_signed_volumes(moved, body.tets).min() < 0.0
    kept = prevent_folds(body.nodes, moved, body.tets)
    assert compute_signed_volumes(kept, body.tets).min() > 0.0
    np.testing.assert_array_equal(kept[thrown], body.nodes[thrown])
    np.testing.assert_array_equal(kept[pushed], moved[pushed])


def test_smoothing_improves_angles_on_the_surface(body):
    rng = np.random.default_rng(1)
    surface = np.zeros(len(body.nodes), bool)
    surface[find_boundary_faces(body.tets)] = True
    nodes = body.nodes + rng.normal(scale=1.2e-3, size=body.nodes.shape)
    level = np.zeros(len(nodes))

    def project(points, of):
        placed = points.copy()
        placed[surface[of]] = project_onto_level(ball, placed[surface[of]], level[of[surface[of]]])
        return placed

    nodes = project(nodes, np.arange(len(nodes)))
    moved = improve_mesh(nodes, body.tets, project)
    np.testing.assert_array_equal(improve_mesh(nodes, body.tets, project, Smoothing(max_iterations=0)), nodes)
    assert compute_smallest_sines(nodes[body.tets]).min() < np.sin(np.radians(5.0))
    assert compute_smallest_sines(moved[body.tets]).min() > np.sin(np.radians(14.0))
    assert np.abs(ball(moved[surface])).max() < 1e-6
    assert compute_signed_volumes(moved, body.tets).min() > 0.0


def test_removed_boundary_tetrahedra_leave_a_manifold(body):
    rough = body.tets[np.linalg.norm(body.nodes[body.tets].mean(axis=1), axis=1) < 0.7 * RADIUS]
    rough = rough[select_manifold(rough)]
    everywhere = np.ones(len(rough), bool)
    gone = find_removable_tetrahedra(rough, everywhere)
    assert gone.any()
    assert select_manifold(rough[~gone]).all()
    assert not find_removable_tetrahedra(rough, ~everywhere).any()
