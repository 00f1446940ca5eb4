"""Normals at nodes, and of bodies smoothed by a Gaussian blur."""

import numpy as np
import pytest
import trimesh
from boxes import blurred_faces

from sim.geometry.surface import BlurRange, compute_blurred_normals, compute_vertex_normals, normalise_vectors

BALL = trimesh.creation.icosphere(subdivisions=5, radius=0.07)  # edges of 2.5 mm
ARM = normalise_vectors(BALL.vertices)


def folded(height: float, waves: int) -> np.ndarray:
    """The ball's nodes (V, 3) [m] with folds of so many waves round it."""
    turn = np.arctan2(ARM[:, 1], ARM[:, 0])
    return BALL.vertices + height * (np.sin(waves * turn) * (1.0 - ARM[:, 2] ** 2))[:, None] * ARM


def off(normals: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Angles (n,) [degrees] between unit vectors."""
    return np.degrees(np.arccos(np.clip((normals * others).sum(axis=1), -1.0, 1.0)))


def test_normals_of_ball_point_away_from_its_centre():
    assert off(compute_vertex_normals(BALL.vertices, BALL.faces), ARM).max() < 0.2
    assert off(compute_blurred_normals(BALL.vertices, BALL.faces, BALL.vertices, 6e-3), ARM).max() < 0.2


def test_blur_removes_folds_narrower_than_its_width():
    """Waves of 18 mm and 1.5 mm height on a radius of 70 mm: Gaussian blurs of 6 mm remove 90 % of them and more."""
    nodes = folded(1.5e-3, 24)
    belt = np.abs(ARM[:, 2]) < 0.3
    assert off(compute_vertex_normals(nodes, BALL.faces), ARM)[belt].max() > 20.0
    assert off(compute_blurred_normals(nodes, BALL.faces, nodes, 6e-3), ARM)[belt].max() < 4.0


def test_blur_keeps_shapes_wider_than_its_width():
    nodes = folded(4e-3, 3)
    found = compute_blurred_normals(nodes, BALL.faces, nodes, 2.5e-3)
    assert off(found, ARM).max() > 8.0
    assert off(found, compute_vertex_normals(nodes, BALL.faces)).max() < 1.0


@pytest.mark.parametrize("blur", [3e-3, 6e-3])
def test_blurred_normals_are_independent_of_mesh_size(blur):
    """Every triangle in four at the same position: only the quadrature changes."""
    coarse = trimesh.creation.box((0.06, 0.05, 0.04))
    for _ in range(4):
        coarse = coarse.subdivide()
    fine = coarse.subdivide()
    points = np.asarray(coarse.vertices)
    one = compute_blurred_normals(points, coarse.faces, points, blur)
    other = compute_blurred_normals(fine.vertices, fine.faces, points, blur)
    assert off(one, other).max() < 2.0


@pytest.mark.parametrize("blur", [3e-3, 6e-3])
def test_blur_agrees_with_gaussian_of_the_given_width(blur):
    """Faces, edges and corners of a box against the closed form; a width with 5 % error differs by 1.5 degrees."""
    size = (0.06, 0.05, 0.04)
    box = trimesh.creation.box(size)
    for _ in range(5):
        box = box.subdivide()
    points = np.asarray(box.vertices)[::5]
    assert (
        off(compute_blurred_normals(box.vertices, box.faces, points, blur), blurred_faces(points, size, blur)).max()
        < 0.5
    )


def test_blurred_normals_of_coarse_ball_point_outward():
    """Edges of 40 mm: no triangle's centre is within a blur of 6 mm of a corner."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.07)
    assert (
        off(
            compute_blurred_normals(ball.vertices, ball.faces, ball.vertices, 6e-3), normalise_vectors(ball.vertices)
        ).max()
        < 0.2
    )


def test_chunked_sum_of_many_points_agrees_with_whole():
    whole = compute_blurred_normals(BALL.vertices, BALL.faces, BALL.vertices[:50], 6e-3)
    parts = compute_blurred_normals(BALL.vertices, BALL.faces, BALL.vertices[:50], 6e-3, BlurRange(block_size=7))
    np.testing.assert_array_equal(parts, whole)
