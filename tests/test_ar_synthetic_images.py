"""Images of printed targets and time stamps."""

import numpy as np
from test_ar_pose import CAMERA, PLATE, flat

from ar.tracking.synthetic_images import render_targets
from ar.tracking.targets import build_calibration_board


def test_hidden_and_back_facing_targets_are_not_drawn():
    front, behind = flat((0.0, 0.0, 0.0), (-0.03, -0.03, 0.3)), flat((0.0, 0.0, 0.0), (-0.03, -0.03, 0.5))
    blank = np.full((600, 800), 120, np.uint8)
    both = render_targets(blank, CAMERA, [(PLATE, front), (build_calibration_board(), behind)])
    other = render_targets(blank, CAMERA, [(build_calibration_board(), behind), (PLATE, front)])
    np.testing.assert_array_equal(both, other)
    assert not np.array_equal(both, render_targets(blank, CAMERA, [(PLATE, front)]))
    away = flat((180.0, 0.0, 0.0), (-0.03, 0.03, 0.3))
    np.testing.assert_array_equal(render_targets(blank, CAMERA, [(PLATE, away)]), blank)
