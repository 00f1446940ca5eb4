"""Poses of a ball as indentations of the cortex."""

from dataclasses import replace

import numpy as np
from test_surrogate_tool_poses import BALL

from sim.loads import Loads, Pushed, Touching
from surrogate.data.cortex_patch import Patch, open_patch
from surrogate.data.indentation import to_indentation
from surrogate.data.tool_loads import draw
from surrogate.data.tool_poses import compute_poses, draw_poses


def domed(points: np.ndarray) -> np.ndarray:
    """A cortex that is not flat: edges and corners are touched, too."""
    out = points.copy()
    out[:, 2] += 3e-3 * np.sin(90.0 * points[:, 0]) * np.cos(110.0 * points[:, 1])
    return out


def samples(patch: Patch) -> np.ndarray:
    share = np.array([(i, j, 24 - i - j) for i in range(25) for j in range(25 - i)]) / 24.0
    return np.einsum("qc,scx->sqx", share, patch.points[patch.triangles]).reshape(-1, 3)


def test_pose_point_is_the_deepest_contact_of_the_ball(box):
    """The point is the nearest one on the surface; depth is the radius minus this distance."""
    patch = open_patch(box)
    bumpy = replace(patch, points=domed(patch.points))
    loads = draw_poses("palpation", box, 60, 3)
    pushed = to_indentation(loads, BALL, bumpy)
    cause = loads.get(Touching)
    assert cause is not None
    pose = cause.pose[:, 0]
    middle = pose[:, :3, 3] + BALL.radius * pose[:, :3, 2]
    depth = np.linalg.norm(pushed.force, axis=1)
    assert (depth > 0.0).sum() > 50
    surface = samples(bumpy)
    nearest = np.array([np.linalg.norm(surface - one, axis=1).min() for one in middle])
    distance = np.linalg.norm(pushed.point - middle, axis=1)
    assert (distance <= nearest + 1e-12).all()
    assert (nearest - distance).max() < 3e-5
    outside = depth < BALL.radius
    np.testing.assert_allclose(depth[outside], np.maximum(BALL.radius - distance, 0.0)[outside], atol=1e-12)
    # The way in: from the middle to the point.
    on = depth > 0.0
    reached = middle[on] + (BALL.radius - depth[on])[:, None] * unit(pushed.force[on])
    np.testing.assert_allclose(reached, pushed.point[on], atol=1e-9)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_indentation_is_independent_of_the_approach_path(box):
    """Flat cortex: an oblique path equals a vertical one at the end point; a half-embedded ball has the normal."""
    patch = open_patch(box)
    forces = draw("palpation", box, 40, 0).get(Pushed)
    assert forces is not None
    normal = patch.find_normals(forces.point)
    motion = 3e-3 * unit(forces.force)
    straight = np.einsum("bi,bi->b", motion, normal)[:, None] * normal
    found = to_indentation(Loads((compute_poses(BALL, forces.point, normal, motion),)), BALL, patch)
    np.testing.assert_allclose(found.point, forces.point + motion - straight, atol=1e-9)
    np.testing.assert_allclose(found.force, straight, atol=1e-9)
    sunk = to_indentation(Loads((compute_poses(BALL, forces.point, normal, BALL.radius * normal),)), BALL, patch)
    np.testing.assert_allclose(sunk.force, BALL.radius * normal, atol=1e-9)


def test_ball_without_contact_has_zero_depth(box):
    patch = open_patch(box)
    point = patch.points[[3, 3]] + [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]
    away = compute_poses(BALL, point, np.array([[0.0, 0.0, -1.0]] * 2), np.array([[0.0, 0.0, -1e-3]] * 2))
    away.pose[0, 0, 2, 3] += 2e-3
    found = to_indentation(Loads((away,)), BALL, patch)
    assert not found.force.any()
    assert np.isfinite(found.point).all()


def test_half_embedded_ball_has_inward_indentation(box):
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, -BALL.radius]  # its middle is on the box's top
    pushed = to_indentation(Loads((Touching(pose[None, None]),)), BALL, open_patch(box))
    np.testing.assert_allclose(pushed.force[0], [0.0, 0.0, -BALL.radius], atol=1e-9)
