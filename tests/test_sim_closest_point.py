"""The closest points of surfaces: of triangles of any size."""

import numpy as np

from sim.geometry.closest_point import find_closest_points


def test_closest_point_of_degenerate_triangle_lies_on_its_edge():
    flat = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [[5.0, 0.0, 0.0]] * 3])
    found = find_closest_points(np.array([[0.5, 1.0, 0.0], [5.0, 2.0, 0.0]]), flat)
    assert np.allclose(found.point, [[0.5, 0.0, 0.0], [5.0, 0.0, 0.0]])


def test_closest_points_of_mixed_triangles_match_brute_force():
    """Triangles of very different sizes, from which candidates for the closest are selected."""
    random = np.random.default_rng(1)
    size = 10.0 ** random.uniform(-3.0, 0.7, (80, 1, 1))
    corners = random.normal(size=(80, 1, 3)) + size * random.normal(size=(80, 3, 3))
    middle = corners.mean(axis=1)
    far = 1e3 * random.normal(size=(20, 3))
    points = np.concatenate([corners[:, 0], middle, middle + 1e-9, far, random.normal(size=(60, 3))])
    found = find_closest_points(points, corners)
    every = find_closest_points(points, np.tile(corners, (len(points), 1, 1, 1)))
    assert np.allclose(found.point, every.point, rtol=1e-12, atol=1e-13)
    assert np.abs(found.point[:80] - corners[:, 0]).max() < 1e-14
    assert np.allclose(np.einsum("bc,bci->bi", found.weights, corners[found.triangle]), found.point, atol=1e-12)
