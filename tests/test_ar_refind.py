"""Outlines that are found again in a picture."""

import cv2
import numpy as np
from test_ar_outlines import camera, tumour

from ar.overlay.hud import write
from ar.overlay.outlines import silhouette
from ar.overlay.refind import outline_gap, stands


def test_an_outline_is_off_by_what_is_astray_and_by_what_is_missing():
    """One that stands 12 pixels off beside the true one, and one of which the right half is not drawn."""
    here, ink = camera(400, 300), (20.0, 240.0, 60.0)
    true = silhouette(here, tumour().vertices, tumour().triangles)
    nothing = np.zeros(true.shape, bool)

    def gap(*masks, left=400):
        colour = np.zeros((*true.shape, 3), np.uint8)
        for mask in masks:
            colour[mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3))).astype(bool)] = ink
        colour[:, left:] = 0
        return outline_gap(colour, ink, true, nothing)

    middle = int(np.nonzero(true)[1].mean())
    assert gap(true) <= 1.0
    assert 9.0 < gap(true, np.roll(true, 12, axis=1)) <= 12.0
    assert gap(true, left=middle) > 15.0
    assert gap(nothing) == np.inf


def test_a_line_of_text_is_found_whole():
    colour = np.full((80, 200, 3), 90, np.uint8)
    write(colour, "11.5 mm", (60, 40))
    found = {text for text in ("11.5 mm", "1.5 mm", "11.6 mm", "5 mm") if stands(colour, text, 0.5)}
    assert found == {"11.5 mm"} and not stands(colour, "11.5 mm", 0.45)
