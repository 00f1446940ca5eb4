"""Errors of an overlay against the truth: outlines, and counts beyond the error band."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from films import follower_of, solve_reference_frames
from theatres import template_theatre

from ar.tracking.pose import TrackedTargets
from scenes.script.scene import find_scene
from scenes.tracked.follower import TrackingResult, TumourState
from scenes.tracked.tool_motion import BrainMotion
from scenes.tracked.truth import OverlayError, compute_overlay_error, summarise_errors


def test_summary_counts_tumours_beyond_their_band_by_1_mm():
    known = [SimpleNamespace(is_reliable=row < 3, bound=2e-3) for row in range(4)]
    errors = [OverlayError(1.0, 0.9, 1e-3, worst, worst <= 2e-3) for worst in (1.9e-3, 2.9e-3, 3.1e-3, 9e-3)]
    found = summarise_errors(known, errors)
    assert (found["pictures"], found["wrong"]) == (3, 1) and found["held_percent"] == pytest.approx(100.0 / 3.0)


def test_outline_error_is_symmetric():
    """Drawn tumour as a small part of the true one, and the reverse."""
    stage = template_theatre().build_stage(find_scene("palpate"))
    rest, calibration, truth = (
        stage.tumour_at_rest.vertices,
        follower_of(stage).calibration,
        solve_reference_frames(stage),
    )
    small, outlines = rest[:1] + 0.2 * (rest - rest[:1]), []
    for drawn, true in ((small, rest), (rest, small)):
        motion = BrainMotion(stage.anatomy.mesh.nodes.copy())
        motion.positions[stage.tumour_vertices] = drawn
        camera, moved = calibration.build_camera(truth.T_camera_scan[0]), np.tile(true - rest, (len(truth.times), 1, 1))
        known = TrackingResult(truth.times[0], TumourState.GOOD, "", TrackedTargets(0, {}, {}, {}), motion, camera)
        outlines.append(compute_overlay_error(known, replace(truth, displacement=moved), calibration, stage).outline)
    assert outlines[0] == pytest.approx(outlines[1]) and outlines[0] > 10.0
