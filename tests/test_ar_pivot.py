"""The tip of a tool, found by pivoting."""

import numpy as np
import pytest
from test_ar_hand_eye import noisy, rigid

from ar.tracking.pivot import pivoted

TIP = np.array([0.002, -0.003, -0.15])


def pivoting(count, tilt=30.0, around=1.0):
    """Poses of a tool whose tip stays at (0.1, 0.2, 0.3), tilted by up to an angle to all sides."""
    found = []
    for number in range(count):
        angle = 2.0 * np.pi * number / count
        turn = np.radians(tilt) * np.array([np.cos(angle), around * np.sin(angle), 0.5 * np.cos(3 * angle)])
        R = rigid(turn, np.zeros(3))
        R[:3, 3] = np.array([0.1, 0.2, 0.3]) - R[:3, :3] @ TIP
        found.append(R)
    return np.array(found)


def test_a_tip_is_found_and_its_deviation_is_that_of_repeated_pivoting():
    exact = pivoted(pivoting(20))
    np.testing.assert_allclose(exact.tip, TIP, atol=1e-12)
    np.testing.assert_allclose(exact.centre, [0.1, 0.2, 0.3], atol=1e-12)
    assert exact.rms < 1e-12 and np.degrees(exact.tilt) == pytest.approx(
        23.7, abs=1.0
    )  # of its x: 30 sqrt((1 + 0.25) / 2)
    rng = np.random.default_rng(0)
    found = [pivoted(noisy(pivoting(40), 0.0, 5e-4, rng)) for _ in range(40)]
    stated = np.sqrt(np.mean([np.diag(each.covariance) for each in found], axis=0))
    seen = np.std([[*each.tip, *each.centre] for each in found], axis=0)
    assert (seen / stated < 1.5).all() and (stated / seen < 1.5).all()
    assert np.mean([each.rms for each in found]) == pytest.approx(5e-4, rel=0.1)


def test_too_little_pivoting_is_refused():
    with pytest.raises(ValueError, match=r"9 poses are too few"):
        pivoted(pivoting(9))
    with pytest.raises(ValueError, match=r"turns by 3\.\d degrees only .*tilt the tool by 30 degrees"):
        pivoted(pivoting(20, tilt=5.0))
    swung = np.array([rigid([0.0, angle, 0.0], np.zeros(3)) for angle in np.linspace(-1.0, 1.0, 20)])
    with pytest.raises(ValueError, match=r"turns by 0\.0 degrees only"):  # far, but about one axis
        pivoted(swung)
