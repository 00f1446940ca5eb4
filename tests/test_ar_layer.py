"""Layers of an image: textures and vertex normals."""

import numpy as np
import pytest
from test_ar_outlines import CORTEX, EYE, ball, camera, sheet

from ar.rendering.layer import Layer, Solid, compute_vertex_normals
from ar.rendering.renderer import Lamp, render


def test_solid_texture_moves_with_the_material():
    """Colour is evaluated at the rest position, and a stripe moves with the vertices."""
    values = np.zeros((19, 2, 2))
    values[9] = 1.0
    scale = np.diag([100.0, 1.0, 1.0, 1.0])
    scale[0, 3] = 9.0
    vertices, triangles = sheet()
    still, moved = (
        render(
            camera(),
            [
                Layer(
                    "cortex",
                    CORTEX,
                    vertices + shift,
                    triangles,
                    (1.0, 1.0, 1.0),
                    solid=Solid(values, scale),
                    rest=vertices,
                )
            ],
            Lamp(EYE, np.zeros(3), 1.0),
        ).colour.sum(axis=-1)
        for shift in ([0.0, 0.0, 0.0], [0.02, 0.0, 0.0])
    )
    pixels = camera().project(np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]]))[0]
    assert np.argmax(still[75]) == pytest.approx(pixels[0, 0], abs=2)
    assert np.argmax(moved[75]) == pytest.approx(pixels[1, 0], abs=2)


def test_vertex_normals_point_out_of_a_sphere():
    vertices, triangles = ball((0.0, 0.0, 0.0), 1.0, 40)
    normals = compute_vertex_normals(vertices, triangles)
    seam = np.abs(vertices[:, 1]) < 1e-9
    assert np.abs(np.abs((normals * vertices).sum(axis=1))[~seam] - 1.0).max() < 5e-3
    assert np.array_equal(compute_vertex_normals(np.zeros((2, 3)), np.zeros((0, 3), int)), np.zeros((2, 3)))
