"""Distance rings and their labels next to the line from the tip."""

import cv2
import numpy as np
from test_ar_styles import CAMERA, TOOL, seen, tumour

from ar.overlay.measured import Measurement
from ar.overlay.window import BORDER_COLOUR, LayerRoles


def test_ring_numbers_avoid_the_line_from_the_tip():
    at = tumour((0.0, 0.0, -0.014))
    roles = LayerRoles((TOOL,), None, None)
    plain, crossed = (np.zeros((480, 640, 4), np.uint8) for _ in range(2))
    box = np.s_[0:480, 0:640]
    measure = Measurement("rings", seen(), CAMERA, at, roles)
    measure.draw(plain, np.zeros_like(plain), box)
    line = np.zeros_like(plain)
    number = (plain[..., :3] == np.array(BORDER_COLOUR, np.uint8)).all(axis=2) & (plain[..., 3] > 0)
    boxes = cv2.erode(number.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0  # more than a line's rim
    assert boxes.any()
    line[boxes, 3] = 255
    measure.draw(crossed, line, box)
    again = (crossed[..., :3] == np.array(BORDER_COLOUR, np.uint8)).all(axis=2) & (crossed[..., 3] > 0)
    assert not (cv2.erode(again.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)[boxes].any()
