"""Streams of poses: clock errors, and covariances between samples."""

import numpy as np
import pytest

from ar.tracking.pose_stream import Clock, build_pose_stream
from scenes.tracked.external_tracker import ExternalTracker


@pytest.mark.parametrize(("error", "expected"), [(0.0, 0.0), (0.01, 2e-3)])
def test_tracker_clock_error_increases_the_covariance(error, expected):
    """Tool at 0.2 m/s; clock error of 10 ms (standard deviation)."""
    times = np.arange(0.0, 1.0, 0.02)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    still, none = build_pose_stream(times, poses.copy(), np.zeros((len(times), 6, 6))), np.zeros((len(times), 6, 6))
    poses[:, 0, 3] = 0.2 * times
    found = ExternalTracker(build_pose_stream(times, poses, none), still, Clock(0.0, error)).find_tool_pose(0.5)
    assert found.covariance[0, 0] == pytest.approx(expected**2, abs=1e-12)
    assert np.abs(found.covariance[1:, 1:]).max() < 1e-12


def test_interpolated_pose_weights_sample_covariances():
    stream = build_pose_stream(
        np.array([0.0, 0.04]), np.tile(np.eye(4), (2, 1, 1)), np.stack([np.eye(6), 4.0 * np.eye(6)])
    )
    np.testing.assert_allclose(stream.interpolate(0.01).covariance, (0.75**2 + 4.0 * 0.25**2) * np.eye(6), atol=1e-12)
