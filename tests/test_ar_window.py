"""Window of an image in which outlines are drawn."""

from dataclasses import replace

import cv2
import numpy as np
import warp as wp
from test_ar_renderer import EGG, LAMP, agree, ball, camera, floor

from ar.overlay.outlines import find_pixel_box
from ar.overlay.window import (
    FADE_DEPTH,
    SOFT_EDGE_WIDTH,
    LayerRoles,
    OverlayLines,
    compute_chamfer_distance,
    draw_overlay,
)
from ar.rendering.layer import compute_vertex_normals
from ar.rendering.rasteriser import rasterise_surface
from ar.rendering.raycast import raycast
from ar.rendering.renderer import render


def test_chamfer_distance_equals_opencv_near_the_edge():
    random = np.random.default_rng(3)
    mask = np.zeros((90, 110), np.uint8)
    for row, column, radius in random.integers((20, 20, 2), (70, 90, 14), (4, 3)):
        cv2.circle(mask, (int(column), int(row)), int(radius), (1,), -1)
    beside = 1 - mask
    known = cv2.distanceTransform(beside, cv2.DIST_L2, cv2.DIST_MASK_3)
    found = compute_chamfer_distance(wp.array(beside, dtype=wp.uint8, device="cpu"), "cpu").numpy()
    near = known < float(SOFT_EDGE_WIDTH)
    assert 0 < near.sum() < near.size and np.abs(found - known)[near].max() < 2e-3
    assert found[~near].min() > float(SOFT_EDGE_WIDTH) - 1e-3


def test_window_overlay_matches_its_numpy_formula():
    """NumPy reference, pixel by pixel: dimmed around the silhouette, and darker for deeper surfaces."""
    here = camera()
    hidden = replace(ball((0.02, 0.0, -0.03)), id=EGG, colour=(0.2, 0.9, 0.3))
    picture = render(here, [floor()], LAMP)
    cast = raycast(here, hidden.vertices, hidden.triangles)
    box = find_pixel_box(here, hidden.vertices)
    assert box is not None
    part = here.crop_to(*box)
    found = rasterise_surface(part, hidden.vertices, hidden.triangles)
    shown, taken = draw_overlay(
        picture.drawn, box, part, hidden, found, LayerRoles(), "window", OverlayLines((0.0, 0.0, 0.0), is_solid=False)
    )
    away = cv2.distanceTransform((~cast.mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3) / float(SOFT_EDGE_WIDTH)
    window = np.clip(1.25 - 1.25 * away, 0.0, 1.0)[..., None]
    wanted = picture.colour * (1.0 - 0.62 * window**2 * (3.0 - 2.0 * window))
    normals = cast.interpolate(hidden.triangles, compute_vertex_normals(hidden.vertices, hidden.triangles))
    facing = normals @ here.T_camera_world[2, :3]
    under = np.where(picture.depth > 0.0, (cast.depth - picture.depth).clip(0.0), 0.0)
    shine = 1.1 * (0.25 + 0.75 * np.abs(facing)) * np.exp(-under / float(FADE_DEPTH)) * cast.mask
    wanted = np.clip(wanted + shine[..., None] * 255.0 * np.array(hidden.colour[0]), 0.0, 255.0).astype(np.uint8)
    assert found.mask.sum() > 300 and agree(shown, wanted) > 0.999
    assert agree(shown, picture.colour) < 0.95 and not taken.any()


def test_overlay_outline_follows_the_silhouette_edge():
    """The line is at the silhouette's edge with a dark rim on both sides; no other pixel changes."""
    here, ink = camera(), (40.0, 220.0, 90.0)
    hidden = replace(ball((0.02, 0.0, -0.03)), id=EGG)
    picture = render(here, [floor()], LAMP)
    box = find_pixel_box(here, hidden.vertices)
    assert box is not None
    part = here.crop_to(*box)
    found = rasterise_surface(part, hidden.vertices, hidden.triangles)
    mask = found.mask.astype(np.uint8)
    edge = (mask - cv2.erode(mask, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))).astype(bool)
    near = cv2.dilate(edge.astype(np.uint8), np.ones((9, 9))).astype(bool)
    shown, taken = draw_overlay(picture.drawn, box, part, hidden, found, LayerRoles(), "contour", OverlayLines(ink))
    inked = np.abs(shown[box].astype(int) - np.array(ink)).max(axis=-1) <= 2
    assert inked[edge].mean() > 0.99 and not taken[~near].any()
    np.testing.assert_array_equal(shown[box][taken == 0], picture.colour[box][taken == 0])
    rim = (taken > 0) & ~inked
    assert (rim & ~found.mask).sum() > 30 and (rim & found.mask).sum() > 30
    assert (shown[box][rim].max(axis=-1) <= picture.colour[box][rim].max(axis=-1) + 2).mean() > 0.6
    same, free = draw_overlay(
        picture.drawn, box, part, hidden, found, LayerRoles((floor().id,)), "contour", OverlayLines(ink)
    )
    np.testing.assert_array_equal(same, picture.colour)
    assert not free.any()
