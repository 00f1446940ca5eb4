"""Tracking results of images: registration, tool and stale states."""

from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest
from films import follower_of, solve_reference_frames
from test_scenes_error_parts import shifted, six, turned
from test_scenes_overlay import pictures
from theatres import template_theatre

from ar.tracking.pose import Pose, TrackedTargets
from ar.tracking.registration import Registration
from scenes.script.scene import find_scene
from scenes.tracked.follower import PATIENT, FollowerSettings, TumourState, compute_tip_covariance
from scenes.tracked.overlay_painter import Painter
from scenes.tracked.run import mark_stale
from scenes.tracked.tracked_tool import TrackedTool
from sim.tools import Ball


def test_uncertain_registration_is_in_band_up_to_limit(follower):
    first = next(iter(pictures())).source
    for shift, state in ((1e-3, TumourState.REST), (3e-3, TumourState.UNSURE)):
        covariance = np.diag(np.repeat([shift**2, 0.0], 3))
        other = replace(follower, registration=replace(follower.registration, covariance=covariance))
        known = other.track(first.grey, 0.0)
        assert known.state is state and known.sources["registration"] == pytest.approx(2.448 * shift, rel=1e-3)
        assert known.bound == pytest.approx(2.448 * shift, rel=0.02)
        assert ("do not rely" in known.warning) is (state is TumourState.UNSURE)


def test_registration_without_anatomy_is_not_reliable(follower):
    first = next(iter(pictures())).source
    other = replace(follower, registration=replace(follower.registration, scan=None))
    known = other.track(first.grey, 0.0)
    assert known.state is TumourState.UNSURE and "not checked whose registration" in known.warning
    assert known.bound == follower.track(first.grey, 0.0).bound


def test_repeated_image_or_stopped_camera_is_stale(follower):
    few = [each.source for each in islice(pictures(), 2)]
    known = follower.track(few[0].grey, 0.0)
    assert follower.track(few[0].grey, 0.0, known).warning.startswith("stale, the camera repeats an image")
    assert follower.track(few[1].grey, 0.5, replace(known, interval=0.1)).state is TumourState.STALE
    assert follower.track(few[1].grey, 0.1, known).state is TumourState.REST
    old = mark_stale(known, 0.5)
    assert old.state is TumourState.STALE and "0.5 s old" in old.warning and mark_stale(known, 0.1) is known


def test_reference_never_detected_gives_no_overlay(follower, stage):
    blank = np.full((720, 960, 3), 120, np.uint8)
    known = follower.track(blank[..., 0], 0.0)
    assert known.state is TumourState.NO_REFERENCE and known.camera is None and "not seen yet" in known.warning
    painted = Painter(stage).paint(blank, known).colour
    foot = painted[600:]
    assert np.array_equal(painted[:600], blank[:600]) and not np.array_equal(foot, blank[600:])
    seen = follower.track(next(iter(pictures())).source.grey, 0.0)
    hold = FollowerSettings().hold_time
    frozen, gone = (follower.track(blank[..., 0], time, seen) for time in (hold, hold + 0.01))
    assert frozen.camera is seen.camera and frozen.warning == "reference lost: drawn where it was"
    assert frozen.bound is None and not frozen.is_reliable and gone.camera is None  # no band of a frozen overlay
    with pytest.raises(ValueError, match="calibrate it at this size"):
        follower.track(blank[::2, ::2, 0], 0.0)


def test_slow_video_is_stale_at_missing_images_only(follower):
    blank, known, states = np.full((720, 960), 120, np.uint8), None, []
    first = next(iter(pictures())).source.grey
    for moment in (0.0, 0.3, 0.6, 0.9, 1.8, 2.1):
        known = follower.track(first, moment, known)
        states.append(known.state)
    assert [each is TumourState.STALE for each in states] == [False, False, False, False, True, False]
    assert follower.track(blank, 2.4, known).state is TumourState.NO_REFERENCE
    assert follower.track(first, 1.5).interval == follower.track(first, 4.0, follower.track(first, 1.5)).interval == 1.0


PARTS = np.array([1e-3, 2e-3, 3e-3])


@pytest.mark.parametrize("source", ["tracking", "tool", "registration"])
def test_tip_covariance_is_rotated_into_the_scan_frame(source):
    """Registration and cube are rotated by 90 degrees; the error lies along (1, 2, 3) in its own frame."""
    T_patient_scan, T_patient_cube = turned("z", 90.0), turned("x", 90.0)
    own, none = np.outer(PARTS, PARTS), np.zeros((3, 3))
    into_patient = T_patient_cube[:3, :3] if source == "tool" else np.eye(3)
    expected = T_patient_scan[:3, :3].T @ into_patient @ PARTS
    found = compute_tip_covariance(
        Registration(T_patient_scan, six(own if source == "registration" else none), np.zeros(3), 0.0, 8),
        TrackedTool(Ball(7e-3), np.eye(4), own if source == "tool" else none),
        Pose(T_patient_cube, six(own if source == "tracking" else none), 0.0, 4),
    )
    np.testing.assert_allclose(found, np.outer(expected, expected), atol=1e-15)


def looking(motion, **given):
    """Return what is known of pictures every 40 ms: `motion` moves the reference before the camera, from the first."""
    follower = replace(follower_of(template_theatre().build_stage(find_scene("palpate"))), tool=None, **given)
    first = solve_reference_frames(follower.motion.stage).T_camera_scan[0] @ np.linalg.inv(
        follower.registration.T_patient_scan
    )
    seen = [TrackedTargets(0, {}, {PATIENT: Pose(T @ first, np.zeros((6, 6)), 0.0, 4)}, {}) for T in motion]
    vars(follower)["tracker"] = SimpleNamespace(track=lambda grey, before: seen[int(grey[0, 0])])
    known = [None]
    for number in range(len(motion)):
        known.append(follower.track(np.full((1, 1), number, np.uint8), 0.04 * number, known[-1]))
    return follower, known[1:]


def test_pace_is_measured_across_the_view_and_decays():
    """Motion of 10 mm along the view, 10 mm across it, then none: each in 40 ms."""
    _, known = looking([shifted(0.0), shifted(0.0, 0.01), shifted(0.01, 0.01), shifted(0.01, 0.01)])
    speeds = [pytest.approx(speed) for speed in (0.0, 0.25, 0.25 * 0.1**0.04)]
    assert [each.image_speed for each in known] == [None, *speeds]


def test_band_has_no_registration_error_along_the_view():
    follower, (known,) = looking([np.eye(4)])
    scan, view = follower.registration, known.camera.T_camera_world[:3]
    sight = view @ [*follower.motion.stage.tumour_at_rest.vertices.mean(axis=0), 1.0]
    sight = scan.T_patient_scan[:3, :3] @ view[:, :3].T @ sight
    for error, expected in ((sight, 0.0), (np.cross(sight, PARTS), 2.4477e-3)):
        own = six(1e-6 * np.outer(error, error) / (error @ error))
        _, (known,) = looking([np.eye(4)], registration=replace(scan, covariance=own))
        assert known.sources["registration"] == pytest.approx(expected, rel=1e-4, abs=1e-7)
