"""Agreement of two trackers: the stored positions."""

import numpy as np
from test_scenes_error_parts import shifted

from ar.tracking.pose import Pose
from scenes.tracked.agreement import Agreement


def test_agreement_keeps_last_30_accurate_positions():
    found, body = Agreement(), Pose(np.eye(4), np.zeros((6, 6)), 0.0, 4)
    for number in range(80):
        deviation = 3e-3 if number % 2 else 1e-3
        found = found.add_image("tool", Pose(shifted(1e-5 * number), deviation**2 * np.eye(6), 0.0, 4), body, None)
    np.testing.assert_allclose(found.positions["tool"][:, 0], 1e-5 * np.arange(20, 80, 2))
