"""Distance rings and their labels."""

import cv2
import numpy as np
from test_ar_styles import CAMERA, seen, tumour

from ar.overlay.composite import composite
from ar.overlay.distances import (
    RING_COLOUR,
    RING_DISTANCES,
    build_bvh,
    compute_visible_distance,
    draw_rings,
    remove_labels,
)
from ar.overlay.hud import FONT, TEXT_SCALE
from ar.overlay.window import BORDER_COLOUR


def test_distance_rings_lie_at_their_distances():
    picture, at = seen(), tumour((0.0, 0.0, -0.014))
    whole, free = np.s_[0:480, 0:640], np.ones((480, 640), bool)
    far = compute_visible_distance(
        build_bvh(at.vertices, at.triangles), CAMERA, whole, picture.drawn.depth[0], free, 18e-3
    )
    sheet = np.zeros((480, 640, 4), np.uint8)
    assert draw_rings(sheet, far, free) == ["5", "10", "15"]
    rows, columns = np.nonzero(sheet[..., 3] == 255)
    points = CAMERA.unproject(np.stack([columns, rows], axis=1).astype(float), picture.depth[rows, columns])
    distance = np.linalg.norm(points - [0.0, 0.0, -0.014], axis=1) - 0.012
    off = np.abs(distance[:, None] - np.array(RING_DISTANCES)).min(axis=1)
    assert len(off) > 1000 and np.percentile(off, 80) < 0.5e-3  # the others are of numbers
    shown = composite(picture, CAMERA, at, style="rings").colour
    assert (shown != composite(picture, CAMERA, at, style="contour").colour).any(axis=2).sum() > 1000


def written(sheet, number):
    """How often a ring's number stands in a sheet of rings."""
    (wide, tall), _ = cv2.getTextSize(number, FONT, TEXT_SCALE, 1)
    stamp = np.full((tall + 3, wide + 3, 3), np.array(BORDER_COLOUR), np.uint8)
    cv2.putText(stamp, number, (2, tall + 2), FONT, TEXT_SCALE, RING_COLOUR, 1, cv2.LINE_AA)
    return int((cv2.matchTemplate(sheet[..., :3].copy(), stamp, cv2.TM_CCOEFF_NORMED) > 0.9).sum())


def test_each_long_ring_segment_is_labelled():
    rows, columns = np.mgrid[:480, :640]
    far = (0.1e-3 * np.hypot(rows - 240.0, columns - 320.0)).astype(np.float32)
    far[:, 300:340] = np.nan  # halves of rings of 50, 100 and 150 pixels
    for free, least in ((np.ones(far.shape, bool), 2), (np.zeros(far.shape, bool), 1)):
        sheet = np.zeros((480, 640, 4), np.uint8)
        assert draw_rings(sheet, far, free) == ["5", "10", "15"]
        assert [written(sheet, number) >= least for number in ("5", "10", "15")] == [True] * 3


def test_ring_mask_excludes_the_pixels_of_ring_labels():
    drawn = np.zeros((80, 120, 4), np.uint8)
    distance = np.repeat(np.linspace(0.0, 8e-3, 120, dtype=np.float32)[None], 80, axis=0)
    assert draw_rings(drawn, distance, np.ones((80, 120), bool), [5e-3]) == ["5"]
    number = cv2.erode((drawn[..., 3] > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    there = remove_labels(drawn[..., 3] > 0)
    assert number.any() and not there[number].any() and there[8:20].any() and there[60:72].any()
