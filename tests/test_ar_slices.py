"""Slices of a scan next to the 3-D view."""

import numpy as np
import pytest

from ar.page.slices import (
    HALF_VIEW,
    PLANES,
    VIEW_SIDE,
    SlicedSurfaces,
    cut_surface,
    draw_slices,
    draw_view,
    find_pixels_within,
    resample_view,
)
from ar.rendering.layer import Layer, Solid
from scenes.script.tool import build_sphere

PITCH = 2.0 * HALF_VIEW / VIEW_SIDE


def ball(radius: float, middle=(0.0, 0.0, 0.0), colour=(0.3, 0.95, 0.55)) -> Layer:
    points, triangles = build_sphere()
    return Layer("ball", 4, np.asarray(middle) + radius * points, triangles, colour)


class TestSection:
    def test_plane_section_of_sphere_is_a_circle(self):
        """Closed, in the plane, with the radius of Pythagoras' theorem."""
        layer, normal = ball(12e-3), np.array([0.6, 0.0, 0.8])
        (line,) = cut_surface(layer.vertices, layer.triangles, 5e-3 * normal, normal)
        assert np.array_equal(line[0], line[-1]) and len(line) > 30
        assert np.abs(line @ normal - 5e-3).max() < 1e-12
        away = np.linalg.norm(line - 5e-3 * normal, axis=1)
        assert np.allclose(away, np.sqrt(12e-3**2 - 5e-3**2), rtol=0.02)

    def test_section_has_one_line_per_intersected_part(self):
        two = [ball(5e-3), ball(5e-3, (20e-3, 0.0, 0.0))]
        vertices = np.concatenate([layer.vertices for layer in two])
        triangles = np.concatenate([two[0].triangles, two[1].triangles + len(two[0].vertices)])
        assert len(cut_surface(vertices, triangles, np.zeros(3), np.array([0.0, 0.0, 1.0]))) == 2
        assert cut_surface(vertices, triangles, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])) == []

    def test_section_of_open_surface_is_an_open_line(self):
        corners = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
        (line,) = cut_surface(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        assert sorted(line[[0, -1], 0]) == [0.0, 1.0] and len(line) == 3


class TestViews:
    @pytest.mark.parametrize("plane", PLANES, ids=lambda plane: plane.name)
    def test_slice_is_resampled_with_the_affine_matrix_of_the_scan(self, plane):
        """A volume whose grey value increases along R, A or S increases by the same amount in the view."""
        for axis in range(3):
            index = np.indices((51, 51, 51))[axis] / 50.0
            scan = Solid(index.astype(np.float32), np.linalg.inv(np.array(np.diag([2e-3, 2e-3, 2e-3, 1.0]) - OFF)))
            found = resample_view(plane, scan, np.zeros(3)).astype(float)
            across, down = (found[:, 200] - found[:, 80]).mean(), (found[200] - found[80]).mean()
            wanted = 190.0 * 120.0 * PITCH / 0.1
            assert across == pytest.approx(wanted * plane.right[axis], abs=1.5)
            assert down == pytest.approx(wanted * plane.down[axis], abs=1.5)

    def test_error_band_has_the_width_of_the_error(self):
        inside = find_pixels_within(PLANES[0], np.zeros(3), ball(15e-3), 5e-3)
        row = np.flatnonzero(inside[VIEW_SIDE // 2])
        widths = [len(part) * PITCH for part in np.split(row, np.flatnonzero(np.diff(row) > 1) + 1)]
        assert widths == pytest.approx([10e-3, 10e-3], abs=1e-3)

    def test_unknown_error_or_unreliable_position_has_no_band(self):
        known = SlicedSurfaces(ball(12e-3), ball(12e-3, (2e-3, 0.0, 0.0)), 4e-3)
        bare, doubtful = (SlicedSurfaces(known.current, known.initial, *more) for more in ((), (4e-3, True)))
        cuts = (known, bare, doubtful)
        green = [np.count_nonzero(tinted(draw_view(PLANES[0], None, np.zeros(3), cut))) for cut in cuts]
        assert green[0] > 2 * green[1] > 0 and green[2] == 0

    def test_slices_have_three_views_for_empty_surface_too(self):
        none = Layer("tumour", 4, np.zeros((0, 3)), np.zeros((0, 3), int))
        for cut in (
            SlicedSurfaces(ball(12e-3), ball(12e-3), 1e-3, tip=np.zeros(3), others=[ball(3e-3)]),
            SlicedSurfaces(none, ball(1e-2), 1e-3),
        ):
            assert draw_slices(None, np.zeros(3), cut).shape == (VIEW_SIDE, 3 * VIEW_SIDE, 3)


OFF = np.array([[0, 0, 0, 5e-2], [0, 0, 0, 5e-2], [0, 0, 0, 5e-2], [0, 0, 0, 0.0]])


def tinted(colour: np.ndarray) -> np.ndarray:
    """(H, W) bool: the pixels that are greener than red."""
    return colour[..., 1].astype(int) > colour[..., 0].astype(int) + 10
