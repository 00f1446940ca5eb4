"""Interpolation at points of one mesh in another."""

import numpy as np
from boxes import box

from sim.geometry.locate import locate


def test_linear_field_is_interpolated_exactly():
    mesh = box((4, 3, 5), distortion=0.2)
    points = np.random.default_rng(0).uniform(0.0, 1.0, (200, 3)) * mesh.nodes.max(axis=0)
    slope = np.random.default_rng(1).normal(size=(2, 3, 3))
    field = np.einsum("bki,vi->bvk", slope, mesh.nodes)
    found = locate(mesh, points)
    assert np.allclose(found.interpolate(field), np.einsum("bki,ni->bnk", slope, points), atol=1e-12)
    assert (found.weights >= 0.0).all() and np.allclose(found.weights.sum(axis=1), 1.0)
    at_home = locate(mesh, mesh.nodes[:50])
    assert np.allclose(at_home.interpolate(field), field[:, :50], atol=1e-12)


def test_point_outside_the_mesh_takes_nearby_values():
    mesh = box((2, 2, 2), size=0.1)
    found = locate(mesh, np.array([[0.03, 0.04, 0.11]]))
    assert np.allclose(found.interpolate(mesh.nodes[None]), [[[0.03, 0.04, 0.1]]], atol=0.01)
    assert (found.weights >= 0.0).all() and np.allclose(found.weights.sum(axis=1), 1.0)
