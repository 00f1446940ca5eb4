"""Fine surface embedded in a coarse one: it follows the motion and stays inside the facets."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ar.rendering.embedding import build_embedded_surface
from scenes.script.tool import build_sphere

POINTS, TRIANGLES = build_sphere(1)


@pytest.fixture(scope="module")
def fine():
    found = build_embedded_surface(POINTS, TRIANGLES, lambda at: np.where(at[:, 2] > 0.0, 0.1, 0.25))
    depth = 0.02 * np.random.default_rng(0).random(len(found.depth))
    return replace(found, depth=depth)


def test_subdivided_edges_are_short_and_shared_by_two_triangles(fine):
    edges, count = np.unique(
        np.sort(fine.triangles[:, [[0, 1], [1, 2], [2, 0]]], 2).reshape(-1, 2), axis=0, return_counts=True
    )
    flat = fine.interpolate(POINTS)
    a, b = flat[edges[:, 0]], flat[edges[:, 1]]
    assert (count == 2).all() and len(flat) - len(edges) + len(fine.triangles) == 2
    assert (np.linalg.norm(a - b, axis=1) <= np.where(0.5 * (a + b)[:, 2] > 0.0, 0.1, 0.25)).all()
    corners = flat[fine.triangles], POINTS[TRIANGLES]
    volume = [np.einsum("fi,fi->f", at[:, 0], np.cross(at[:, 1], at[:, 2])).sum() for at in corners]
    assert volume[0] == pytest.approx(volume[1])


def test_rigid_motion_carries_the_fine_surface_exactly(fine):
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8])
    found = fine.compute_vertices(turn.apply(POINTS) + [1.0, 2.0, 3.0])
    assert np.allclose(found, turn.apply(fine.compute_vertices(POINTS)) + [1.0, 2.0, 3.0], atol=1e-12)


def test_linear_field_is_interpolated_exactly(fine):
    A = np.random.default_rng(1).standard_normal((3, 3))
    assert np.allclose(fine.interpolate(POINTS @ A + 1.0), fine.interpolate(POINTS) @ A + 1.0, atol=1e-12)


def test_fine_vertices_stay_inside_the_coarse_facets(fine):
    random = np.random.default_rng(2)
    for at in (POINTS, POINTS + 0.05 * random.standard_normal(POINTS.shape)):
        normals = fine.interpolate(at) - fine.compute_vertices(at)
        a, b, c = np.moveaxis(at[fine.corners], 1, 0)
        outward = np.cross(b - a, c - a)
        inside = fine.weights.min(axis=1) > 0.0
        side = np.sign(np.einsum("mi,mi->m", outward, a))  # corners are in no order
        assert (side * np.einsum("mi,mi->m", outward, normals) >= -1e-12)[inside].all()


def test_rounding_reduces_radius_error_of_coarse_sphere(fine):
    free = replace(fine, depth=np.zeros(len(fine.depth)), max_height=np.inf, rounding=0.5)
    flat, found = (np.linalg.norm(at, axis=1) for at in (fine.interpolate(POINTS), free.compute_vertices(POINTS)))
    assert np.abs(found - 1.0).max() < 0.25 * np.abs(flat - 1.0).max()
