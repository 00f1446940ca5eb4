"""Points on the surface that are nearest to a tool's core."""

import numpy as np
import pytest

from sim.discretisation.nearest_points import PlacedBox


@pytest.mark.parametrize("half", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.4], [0.3, 0.5, 1e-9], [0.2, 0.3, 0.4]])
def test_nearest_point_to_tool_core_agrees_with_lattice(half: list[float]) -> None:
    """Against a fine lattice on random triangles, whether or not they cut the core."""
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(150, 3, 3)) * rng.uniform(0.3, 1.0, (150, 1, 3))
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    core = PlacedBox(np.array([0.3, -0.2, 0.1]), axes, np.array(half))
    share, far, way = core.find_nearest(corners)
    assert share.min() >= 0.0
    again, direction = core.compute_distances(corners, share)
    np.testing.assert_allclose(again, far, atol=1e-12)
    np.testing.assert_allclose(direction[far > 1e-9], way[far > 1e-9], atol=1e-6)
    lattice = np.array([(i, j, 60 - i - j) for i in range(61) for j in range(61 - i)]) / 60.0
    best = np.min([core.compute_distances(corners, np.tile(each, (150, 1)))[0] for each in lattice], axis=0)
    off = np.maximum(far - best, 0.0)
    assert off.max() < 0.02 and np.percentile(off, 90) < 1e-6 and (best - far).max() < 0.05
    np.testing.assert_allclose(np.linalg.norm(way[far > 1e-9], axis=1), 1.0)


def test_triangle_through_blade_has_negative_distance() -> None:
    """The farther above, the deeper inside; outside the blade the nearest edge counts."""
    blade = PlacedBox(np.zeros(3), np.eye(3), np.array([4.0, 6.0, 0.0]))
    flat = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    tilted = flat + [[0.0, 0.0, 0.1], [0.0, 0.0, 0.7], [0.0, 0.0, -0.2]]
    near = blade.find_nearest(
        np.array([flat + [0.0, 0.0, 0.5], tilted, flat - [0.0, 0.0, 0.5], flat + [8.0, 0.0, 0.5]])
    )
    np.testing.assert_allclose(near.distance, [-0.5, -0.7, 0.5, np.hypot(3.0, 0.5)])
    np.testing.assert_allclose(near.normal[:3], [[0.0, 0.0, -1.0]] * 3, atol=1e-12)
    np.testing.assert_allclose(near.barycentric[1], [0.0, 1.0, 0.0])
    distance, normal = blade.compute_distances(np.array([tilted] * 2), np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(distance, [-0.7, 0.2])
    np.testing.assert_allclose(normal, [[0.0, 0.0, -1.0]] * 2, atol=1e-12)
