"""The bone's edge at a craniotomy, and motion of open cortex next to it and below it."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, hold

from sim.accuracy import REFERENCE
from sim.anatomy import Anatomy
from sim.discretisation.space import discretise
from sim.effects import Elasticity, Held, NodalForce, SkullContact
from sim.fem import Fem
from sim.loads import Loads, Nodal
from sim.material import Material
from sim.terms.contact.skull_surface import (
    BONE_SETTINGS,
    build_bone,
    compute_edge_radius,
    find_opening_edge,
    measure_inside_opening,
)

MESH = box((10, 6, 3), 0.05)
HEIGHT = MESH.nodes[:, 2].max()
TOP = MESH.nodes[:, 2] > HEIGHT - 1e-9
# Open where x > 25 mm: its edge lies between two rows of nodes.
END = 0.0275
OPEN = TOP & (MESH.nodes[:, 0] > END)
MIDDLE = np.abs(MESH.nodes[:, 1] - 0.015) < 6e-3
GAP = 1e-4


def half_open(opened: np.ndarray = OPEN) -> Anatomy:
    """A block held from below, under a flat bone, open where nodes (V,) are `opened`."""
    below = hold(MESH, MESH.nodes[:, 2] < 1e-9, (TOP & ~OPEN)[:, None] * [0.0, 0.0, 1.0])
    return Anatomy(MESH, below.fixed, below.slide_normal, opened)


def test_distance_inside_a_straight_edge_is_measured() -> None:
    """To a tenth of the edge's radius within its blur, with its direction."""
    body = half_open()
    edge = compute_edge_radius(MESH.nodes, find_opening_edge(body))
    points = MESH.nodes[TOP & MIDDLE]
    inside, way = measure_inside_opening(body, points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), edge)
    near = np.abs(points[:, 0] - END) < edge
    np.testing.assert_allclose(inside[near], points[near, 0] - END, atol=0.1 * edge)
    np.testing.assert_allclose(way[near], np.tile([1.0, 0.0, 0.0], (near.sum(), 1)), atol=0.05)
    assert (np.sign(inside) == np.sign(points[:, 0] - END)).all()


def test_distance_inside_a_round_opening_is_measured() -> None:
    """A disc in a flat bone, with the area of its nodes, to a third of the edge's radius: ragged edges are smoothed."""
    mesh = box((14, 14, 2), 0.07)
    top = mesh.nodes[:, 2] > mesh.nodes[:, 2].max() - 1e-9
    away = np.linalg.norm(mesh.nodes[:, :2] - 0.035, axis=1)
    opened = top & (away < 0.018)
    lid = hold(mesh, mesh.nodes[:, 2] < 1e-9, (top & ~opened)[:, None] * [0.0, 0.0, 1.0])
    body = Anatomy(mesh, lid.fixed, lid.slide_normal, opened)
    edge = compute_edge_radius(mesh.nodes, find_opening_edge(body))
    points = mesh.nodes[top]
    inside, way = measure_inside_opening(body, points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), edge)
    radius = np.sqrt(opened.sum() / np.pi) * 0.005
    near = np.abs(away[top] - radius) < edge
    assert np.abs(inside[near] - (radius - away[top][near])).max() < edge / 3.0
    inwards = (0.035 - points[near, :2]) / away[top][near, None]
    assert (way[near, :2] * inwards).sum(axis=1).min() > 0.9


def test_body_without_an_opening_has_only_bone() -> None:
    body = half_open(np.zeros(len(TOP), bool))
    bone = build_bone(body, discretise(MESH, "p1"), GAP)
    np.testing.assert_array_equal(bone.nodes, np.flatnonzero(TOP & ~OPEN))
    np.testing.assert_array_equal(bone.activation, BONE_SETTINGS.activation)
    assert (bone.inside_distance < 0.0).all()


def dragged(body: Anatomy, element: str) -> np.ndarray:
    """Motions (V, 3) [m] of a body whose open surface is pushed under the bone and upwards."""
    force = OPEN[:, None] * [-0.7, 0.0, 0.35] / OPEN.sum()
    tissue = Elasticity(Material("neo-hookean", 3000.0, 0.45))
    effects, accuracy = [tissue, Held(), NodalForce(), SkullContact(GAP)], replace(REFERENCE, limit_strain=False)
    fem = Fem(body, effects, accuracy, "cpu", element=element)
    found = fem.deform(Loads((Nodal(force[None]),)))
    assert found.outcome[0].good
    return found.displacement[0]


@pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
def test_open_cortex_slides_under_bone_without_penetration(element: str) -> None:
    """Round an edge as round as the mesh; without the opening, cortex would enter the bone by millimetres."""
    edge = compute_edge_radius(MESH.nodes, find_opening_edge(half_open()))

    def depth(u: np.ndarray) -> np.ndarray:
        """How deep (n,) [m] open nodes in the middle are in a bone whose edge is round."""
        at = (MESH.nodes + u)[OPEN & MIDDLE & (MESH.nodes[:, 0] < 0.041)]
        h, r = HEIGHT + GAP - at[:, 2], at[:, 0] - END
        return edge - np.linalg.norm(np.maximum(np.stack([h + edge, r + edge]), 0.0), axis=0)

    assert depth(dragged(half_open(np.zeros(len(TOP), bool)), element)).max() > 1e-3
    barred = depth(dragged(half_open(), element))
    assert barred.max() < 0.1 * BONE_SETTINGS.edge_activation * edge
    assert barred.max() > -edge, "nothing came near the edge"


def test_cortex_far_from_the_edge_rises_freely() -> None:
    """Pushed away from the edge, cortex rises as without bone."""
    tissue = Elasticity(Material("neo-hookean", 3000.0, 0.45))
    push = Loads((Nodal((OPEN[:, None] * [0.2, 0.0, 0.6] / OPEN.sum())[None]),))

    def moved(*effects: SkullContact) -> np.ndarray:
        return (
            Fem(half_open(), [tissue, Held(), NodalForce(), *effects], REFERENCE, "cpu", element="p1")
            .deform(push)
            .displacement[0]
        )

    far = OPEN & (MESH.nodes[:, 0] > 0.04)
    barred, free = moved(SkullContact(GAP)), moved()
    assert free[far, 2].min() > 1e-3
    np.testing.assert_allclose(barred[far], free[far], atol=0.05 * free[far, 2].max())
