"""Camera framing by the tumour: outline inside the craniotomy, error band inside the image."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.script.framing import BAND_MARGIN, MIN_VISIBLE, build_hole_edges, compute_visible_share, find_framing
from scenes.script.viewpoint import OBLIQUE_VIEWPOINT, USUAL_VIEWPOINT, Viewpoint

from .theatres import REAL, template_theatre


def count_inside(camera, points):
    """Share of points (n, 3) that an image contains."""
    pixels = camera.project(points)[0]
    return ((pixels >= 0.0) & (pixels < [camera.width, camera.height])).all(axis=1).mean()


def grow(anatomy):
    """The points of a tumour's surface, 8 mm farther from its centre."""
    surface = anatomy.mesh.nodes[np.unique(anatomy.tumour_surface)]
    arm = surface - surface.mean(axis=0)
    return surface + BAND_MARGIN * arm / np.linalg.norm(arm, axis=1, keepdims=True)


@pytest.mark.parametrize("size", [(640, 480), (400, 900), (1600, 300)])
def test_outline_lies_in_craniotomy_and_band_in_image(size):
    site = template_theatre().site
    view = Viewpoint(width=size[0], height=size[1])
    camera = view.build_camera(site)
    surface = site.anatomy.mesh.nodes[np.unique(site.anatomy.tumour_surface)]
    assert compute_visible_share(camera, surface, build_hole_edges(site)) >= MIN_VISIBLE - 0.03
    assert count_inside(camera, np.vstack([grow(site.anatomy), *build_hole_edges(site)])) == 1.0
    assert np.linalg.norm(camera.centre - view.find_target(site)) == pytest.approx(0.3)
    another = OBLIQUE_VIEWPOINT.build_camera(site)
    assert compute_visible_share(another, surface, build_hole_edges(site)) < 0.6


def test_view_has_the_largest_tilt_that_shows_the_cortex():
    site = template_theatre().site
    found = USUAL_VIEWPOINT.find_framing(site)
    tilt = np.arccos(-found.direction @ site.axis)
    assert 0.2 < tilt < 0.6 and found.visible_share >= MIN_VISIBLE
    assert find_framing(site, 0.3, 4.0 / 3.0, (tilt + 0.2, 0.0)).visible_share < MIN_VISIBLE
    down = find_framing(site, 0.3, 4.0 / 3.0, (0.0, 0.0))
    assert down.direction == pytest.approx(-site.axis) and down.visible_share >= MIN_VISIBLE


def test_calibrated_camera_shows_the_tumour_with_its_error_band():
    site, view = template_theatre().site, USUAL_VIEWPOINT.calibrate(replace(REAL, lens=None))
    assert count_inside(view.build_camera(site), grow(site.anatomy)) == 1.0
