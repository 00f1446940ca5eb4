"""Distance label at the tip."""

import numpy as np
import pytest
from test_ar_styles import CAMERA, seen, tumour

from ar.overlay.composite import composite
from ar.overlay.gauge import NUMBER_SCALE, DistanceGauge, format_tip_distance
from ar.overlay.marks import Marks
from ar.overlay.outlines import find_text, has_text


@pytest.mark.parametrize("tip", [(0.0, 0.0), (0.052, 0.03), (-0.07, 0.0), (0.0, -0.09), (0.3, 0.3)])
def test_distance_label_is_near_the_tip_inside_the_image(tip):
    picture = seen()
    gauge = DistanceGauge(np.array([*tip, 0.0]), np.array([0.0, 0.0, -0.008]), error=1.2e-3)
    shown = composite(picture, CAMERA, tumour(), marks=Marks(gauge=gauge)).colour
    found = find_text(shown, str(gauge), NUMBER_SCALE)
    assert found is not None
    left, top, right, foot = found
    assert left >= 4 and top >= 4 and right <= 636 and foot <= 476
    pixel = np.clip(CAMERA.project(gauge.tip[None])[0][0], 0, (639, 479))
    assert np.linalg.norm(pixel - np.clip(pixel, found[:2], found[2:])) < 110


def test_tip_inside_tumour_is_labelled_inside():
    assert format_tip_distance(2.1e-3, None, True) == "inside, 2.1 mm from its edge"
    assert format_tip_distance(2.1e-3, 1e-3, False) == "2.1 +- 1.0 mm"
    gauge = DistanceGauge(np.array([0.0, 0.0, -0.02]), np.array([0.0, 0.0, -0.008]), is_inside=True)
    assert has_text(
        composite(seen(), CAMERA, tumour(), marks=Marks(gauge=gauge)).colour,
        "inside, 12.0 mm from its edge",
        NUMBER_SCALE,
    )
