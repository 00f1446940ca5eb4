"""Rasteriser for cameras with lens distortion."""

import numpy as np
from test_ar_lens import each_lens, seen_by
from test_ar_rasteriser import build_sphere

from ar.overlay.outlines import compute_silhouette, find_pixel_box
from ar.rendering.rasteriser import rasterise
from ar.rendering.raycast import raycast


@each_lens
def test_lens_rasteriser_matches_ray_casting(lens):
    """Small triangles, and one as large as the image that reaches behind the camera and beyond the lens limit."""
    camera, (vertices, triangles) = seen_by(lens), build_sphere(20, 30, 0.02)
    vertices = np.concatenate([vertices + [0.01, 0.0, 0.03], [[-9.0, -9, -0.3], [9, -8, -0.3], [0, 9, 0.3]]])
    triangles = np.concatenate([triangles, [[600, 601, 602]] + np.array(len(vertices) - 603)])
    drawn, cast = rasterise(camera, vertices, triangles), raycast(camera, vertices, triangles)
    same = drawn.face == cast.face
    assert same.mean() > 0.998 and len(np.unique(cast.face)) > 200 and (cast.face == len(triangles) - 1).mean() > 0.2
    assert np.abs(drawn.depth - cast.depth)[same].max() < 1e-5
    assert np.abs(drawn.weights - cast.weights)[same].max() < 1e-2
    assert (drawn.face[np.isnan(camera.straight[..., 0])] == -1).all()


@each_lens
def test_pixel_box_contains_a_distorted_triangle(lens):
    """The triangle is as large as the image, and distortion bends its edges."""
    camera = seen_by(lens)
    points = np.array([[-0.08, -0.05, 0.0], [0.08, -0.05, 0.0], [0.0, 0.08, 0.0]])
    mask = compute_silhouette(camera, points, np.array([[0, 1, 2]]))
    rows, columns = find_pixel_box(camera, points)
    outside = mask.copy()
    outside[rows, columns] = False
    assert mask.sum() > 5000 and not outside.any()
