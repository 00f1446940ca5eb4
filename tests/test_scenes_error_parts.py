"""Parts of an overlay's error that are known exactly: registration, clock, and covariances that are turned."""

from dataclasses import replace

import numpy as np
import pytest
from films import follower_of, truth_of
from links import in_mm
from scipy.spatial.transform import Rotation
from theatres import template_theatre

from ar.tracking.clocks import Clock
from ar.tracking.pose import Pose
from ar.tracking.pose_stream import stream_of
from ar.tracking.registration import Registration
from scenes.link.answer import Answering
from scenes.link.heard import Heard, Names
from scenes.play.overlay.elsewhere import Elsewhere
from scenes.play.overlay.follower import tip_covariance
from scenes.script.scene import find_scene
from scenes.script.tracked_tool import TrackedTool
from sim.tools import Ball

PARTS = np.array([1e-3, 2e-3, 3e-3])


def turned(axis, degrees):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return T


def six(shift):
    """Covariance (6, 6) of a shift alone."""
    whole = np.zeros((6, 6))
    whole[:3, :3] = shift
    return whole


@pytest.mark.parametrize("shift", [1e-6 * np.eye(3), np.diag([1e-6, 0.0, 0.0])])
def test_link_bound_of_registration_is_2_80_sigma(shift):
    """The ball that holds 95 % of an isotropic error of 1 mm along each axis."""
    follower, names = follower_of(template_theatre().stage(find_scene("palpate"))), Names()
    given = replace(follower.registration, covariance=six(shift))
    pose = truth_of(follower.motion.stage).T_scan_tool[10] @ np.linalg.inv(follower.tool.T_cube_tool)
    heard = Heard(names, 1.0).hearing(names.tool, in_mm(given.T_patient_scan @ pose), 1, 0.0, 0)
    found = Answering(follower.motion, follower.tool, 5e-4, given).answer(heard, 0.0, 0.0)
    assert found.known.parts["registration"] == pytest.approx(2.7955e-3, rel=1e-4)


@pytest.mark.parametrize(("error", "expected"), [(0.0, 0.0), (0.01, 2e-3)])
def test_tracker_clock_error_is_in_the_covariance(error, expected):
    """A tool at 0.2 m/s, and a clock that is known to 10 ms."""
    times = np.arange(0.0, 1.0, 0.02)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    still, none = stream_of(times, poses.copy(), np.zeros((len(times), 6, 6))), np.zeros((len(times), 6, 6))
    poses[:, 0, 3] = 0.2 * times
    found = Elsewhere(stream_of(times, poses, none), still, Clock(0.0, error)).beside(0.5)
    assert found.covariance[0, 0] == pytest.approx(expected**2, abs=1e-12)
    assert np.abs(found.covariance[1:, 1:]).max() < 1e-12


@pytest.mark.parametrize("source", ["tracking", "tool", "registration"])
def test_tip_covariance_is_turned_into_the_scan(source):
    """A quarter turn of the registration, another one of the cube; an error along (1, 2, 3) in its own frame."""
    T_patient_scan, T_patient_cube = turned("z", 90.0), turned("x", 90.0)
    own, none = np.outer(PARTS, PARTS), np.zeros((3, 3))
    into_patient = T_patient_cube[:3, :3] if source == "tool" else np.eye(3)
    expected = T_patient_scan[:3, :3].T @ into_patient @ PARTS
    found = tip_covariance(
        Registration(T_patient_scan, six(own if source == "registration" else none), np.zeros(3), 0.0, 8),
        TrackedTool(Ball(7e-3), np.eye(4), own if source == "tool" else none),
        Pose(T_patient_cube, six(own if source == "tracking" else none), 0.0, 4),
    )
    np.testing.assert_allclose(found, np.outer(expected, expected), atol=1e-15)
