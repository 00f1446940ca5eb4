"""Exactly known parts of an overlay's error: registration, hand-eye calibration, tool and model."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from films import follower_of, solve_reference_frames
from links import in_mm
from scipy.spatial.transform import Rotation
from theatres import template_theatre

from ar.tracking.pose_stream import build_pose_stream
from ar.tracking.rigid import move_rigidly
from scenes.link.pose_responder import PoseResponder
from scenes.link.received_transforms import ReceivedTransforms, TransformNames
from scenes.script.scene import find_scene
from scenes.tracked.external_tracker import CameraMount, ExternalTracker
from scenes.tracked.follower import TumourState
from scenes.tracked.run import Overlay, write_tracking_table
from scenes.tracked.tool_motion import NO_ERROR_WARNING, BrainMotion, ToolMotion
from scenes.tracked.truth import OverlayError
from sim.loads import Touching
from surrogate.model.learned import build_prediction


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
    """Ball with 95 % of an isotropic error of 1 mm along each axis."""
    follower, names = follower_of(template_theatre().build_stage(find_scene("palpate"))), TransformNames()
    given = replace(follower.registration, covariance=six(shift))
    pose = solve_reference_frames(follower.motion.stage).T_scan_tool[10] @ np.linalg.inv(follower.tool.T_cube_tool)
    heard = ReceivedTransforms(names, 1.0).add_transform(names.tool, in_mm(given.T_patient_scan @ pose), 1, 0.0, 0)
    found = PoseResponder(follower.motion, follower.tool, 5e-4, given).compute_result(heard, 0.0, 0.0)
    assert found.tracking.sources["registration"] == pytest.approx(2.7955e-3, rel=1e-4)
    assert found.tracking.bound == pytest.approx(np.hypot(2.7955e-3, found.tracking.motion.error), rel=1e-4)


def test_hand_eye_error_equals_shift_of_the_camera():
    """Small shift and rotation of the camera in its mount's frame, along one direction of six."""
    times, step = np.zeros(1), 1e-4 * np.array([1.0, -2.0, 3.0, 5.0, -3.0, 2.0])
    T, far = (
        turned("zx", [30.0, 50.0]) @ shifted(0.3),
        build_pose_stream(times, shifted(0.5, 0.8)[None], np.zeros((1, 6, 6))),
    )
    right, other = (
        ExternalTracker(far, far, mount=CameraMount(each, np.outer(step, step)))
        for each in (T, move_rigidly(T, np.zeros(3), step))
    )
    found, there = right.find_reference_pose(0.0), other.find_reference_pose(0.0).T_camera_target
    turn = Rotation.from_matrix(there[:3, :3] @ found.T_camera_target[:3, :3].T).as_rotvec()
    moved = np.append(there[:3, 3] - found.T_camera_target[:3, 3], turn)
    np.testing.assert_allclose(found.covariance, np.outer(moved, moved), rtol=0.0, atol=2e-3 * (moved @ moved))


def shifted(x, z=0.0):
    T = np.eye(4)
    T[:3, 3] = x, 0.0, z
    return T


@dataclass(frozen=True)
class Sinking:
    """A tumour that goes as deep as the tool, once that is below the opening's middle; it keeps every start."""

    stage: object
    starts: list = field(default_factory=list)

    def deform(self, loads, start=None, at=None):
        self.starts.append(start)
        (cause,), site, nodes = loads.get_all(Touching), self.stage.site, self.stage.tumour_vertices
        depth = np.maximum((cause.pose[:, 0, :3, 3] - site.origin) @ site.axis, 0.0)
        moved = np.broadcast_to(depth[:, None, None] * site.axis, (len(depth), len(nodes), 3))
        return build_prediction(moved, nodes, loads, [False] * len(depth), 0.0, np.full((2, len(depth)), np.nan), "")


def test_tool_error_comes_from_a_deeper_tool_pose():
    stage = template_theatre().build_stage(find_scene("palpate"))
    sinking, pose = Sinking(stage), np.eye(4)
    pose[:3, 3] = stage.site.origin
    first = ToolMotion(stage, sinking).compute_motion(pose, np.diag([1e-6, 1e-8, 1e-8]))
    assert first.distance == pytest.approx(0.0, abs=1e-9) and first.tool_error == pytest.approx(1.96e-3, rel=1e-3)
    ToolMotion(stage, sinking).compute_motion(pose, 1e-6 * np.eye(3), first)
    assert sinking.starts[0] is None and sinking.starts[2] is first.solution


@pytest.mark.parametrize(("bound", "expected", "doubt"), [(3e-4, 3e-4, ""), (np.inf, 0.0, NO_ERROR_WARNING)])
def test_missing_error_bound_is_replaced_by_bound_of_model(bound, expected, doubt, monkeypatch):
    model = SimpleNamespace(bound=bound)
    monkeypatch.setattr("scenes.tracked.tool_motion.find_first_model", lambda deformer, answer: model)
    stage = template_theatre().build_stage(find_scene("palpate"))
    found = ToolMotion(stage, Sinking(stage)).compute_motion(np.eye(4), np.zeros((3, 3)))
    assert (found.model_error, found.warning) == (expected, doubt)


def test_rows_of_an_overlay_are_in_millimetres(tmp_path):
    names = ("tracking", "camera", "registration", "tool", "model", "shutter")
    parts = {name: 1e-3 * (number + 7) for number, name in enumerate(names)}
    known = SimpleNamespace(
        camera=0,
        motion=BrainMotion(np.zeros(0), True, 4e-3, 3e-3, 4e-3),
        bound=6e-3,
        sources=parts,
        time=1.0,
        state=TumourState.GOOD,
        warning="",
    )
    shown = Overlay(known, np.zeros(0), 0.013, 1e-3 * np.arange(1, 4), 0.014)
    write_tracking_table(tmp_path / "rows.csv", [shown], [OverlayError(15.0, 16.0, 17e-3, 18e-3, True)])
    cells = (tmp_path / "rows.csv").read_text().splitlines()[1].split(",")
    assert [float(cell) for cell in cells[2:16] + cells[17:21]] == pytest.approx([*range(1, 19)])
