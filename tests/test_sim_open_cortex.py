"""The open cortex: its frame, positions on it, and the closest points of surfaces."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy
from sim.bodies.open_cortex import open_cortex
from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points


@pytest.fixture(scope="module")
def template():
    return read_anatomy(get_template_path())


def test_closest_points_agree_with_trimesh(template):
    random = np.random.default_rng(0)
    triangles = template.tumour_surface
    nodes = template.mesh.nodes
    surface = trimesh.Trimesh(nodes, triangles, process=False)
    points = nodes[template.tumour_nodes].mean(axis=0) + random.normal(scale=0.015, size=(200, 3))
    found = find_closest_points(points, nodes[triangles])
    there, distance, _ = trimesh.proximity.closest_point_naive(surface, points)
    assert np.linalg.norm(found.point - points, axis=1) == pytest.approx(distance, abs=1e-12)
    assert np.abs(found.point - there).max() < 1e-9
    assert (found.weights >= 0.0).all() and found.weights.sum(axis=1) == pytest.approx(1.0)
    corners = nodes[triangles[found.triangle]]
    assert np.allclose(np.einsum("bc,bci->bi", found.weights, corners), found.point, atol=1e-15)
    # Every surface its own point.
    shifts = random.normal(scale=1e-3, size=(200, 1, 1, 3))
    moved = find_closest_points(points + shifts[:, 0, 0], nodes[triangles] + shifts)
    assert np.allclose(moved.point - shifts[:, 0, 0], found.point, atol=1e-12)


def test_place_on_cortex_has_requested_offsets(template):
    cortex = open_cortex(template)
    assert np.allclose(cortex.place().point, cortex.origin, atol=1e-12)
    for right, up in ((5.0, 0.0), (0.0, -7.0), (-6.0, 6.0)):
        place = cortex.place(right_mm=right, up_mm=up)
        way = 1e3 * (place.point - cortex.origin)
        assert way @ cortex.right == pytest.approx(right, abs=1.5) and way @ cortex.up == pytest.approx(up, abs=1.5)
        assert np.linalg.norm(place.inward) == pytest.approx(1.0)
        assert place.inward @ cortex.axis > 0.7  # into the brain
        assert np.allclose(place.locate(template.mesh.nodes), place.point, atol=1e-15)
        assert np.isin(place.vertices, template.open_surface).all()


@pytest.mark.parametrize("asked", [(60.0, 0.0), (0.0, -200.0)])
def test_place_under_the_bone_is_rejected(template, asked):
    with pytest.raises(InputError, match="outside the open cortex: stay within"):
        open_cortex(template).place(*asked)


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"right_mm": "x"}, "right_mm has the type <U1: give real numbers"),
        ({"up_mm": None}, "up_mm has the type object: give real numbers"),
        ({"up_mm": [1.0, 2.0]}, r"up_mm has shape \(2,\): give one number, in millimetres"),
        ({"right_mm": float("nan")}, "right_mm has a value that is not finite"),
    ],
)
def test_place_with_invalid_number_is_rejected(template, asked, reason):
    with pytest.raises(InputError, match=reason):
        open_cortex(template).place(**asked)


def test_body_without_craniotomy_has_no_open_cortex(template):
    closed = replace(template, craniotomy=np.zeros(len(template.mesh.nodes), bool))
    with pytest.raises(InputError, match="no open cortex"):
        open_cortex(closed)
