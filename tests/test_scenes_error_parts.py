"""Parts of an overlay's error that are known exactly: registration, clock, and covariances that are turned."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from films import follower_of, truth_of
from links import in_mm
from scipy.spatial.transform import Rotation
from theatres import template_theatre

from ar.optics.camera import Camera
from ar.tracking.calibration_error import calibration_error
from ar.tracking.clocks import Clock
from ar.tracking.pose import Pose
from ar.tracking.pose_stream import stream_of
from ar.tracking.registration import Registration
from ar.tracking.rigid import moved_about
from ar.tracking.targets import patient_reference
from ar.tracking.track import Tracked
from scenes.link.answer import Answering
from scenes.link.heard import Heard, Names
from scenes.script.scene import find_scene
from scenes.tracked.agreement import Agreement
from scenes.tracked.elsewhere import Elsewhere, Eye
from scenes.tracked.follower import PATIENT, Known, State, tip_covariance
from scenes.tracked.rows import write_rows
from scenes.tracked.run import Shown
from scenes.tracked.tool_motion import UNBOUND, Motion, ToolMotion
from scenes.tracked.tracked_tool import TrackedTool
from scenes.tracked.truth import Off, off, summary
from sim.loads import Touching
from sim.tools import Ball
from surrogate.model.learned import predicted

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
    assert found.known.band == pytest.approx(np.hypot(2.7955e-3, found.known.motion.error), rel=1e-4)


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


def test_hand_eye_error_is_that_of_a_camera_moved_by_it():
    """A small shift and turn of the camera, in the axes of what carries it, along one direction of all six."""
    times, step = np.zeros(1), 1e-4 * np.array([1.0, -2.0, 3.0, 5.0, -3.0, 2.0])
    T, far = turned("zx", [30.0, 50.0]) @ shifted(0.3), stream_of(times, shifted(0.5, 0.8)[None], np.zeros((1, 6, 6)))
    right, other = (
        Elsewhere(far, far, eye=Eye(each, np.outer(step, step))) for each in (T, moved_about(T, np.zeros(3), step))
    )
    found, there = right.reference(0.0), other.reference(0.0).T_camera_target
    turn = Rotation.from_matrix(there[:3, :3] @ found.T_camera_target[:3, :3].T).as_rotvec()
    moved = np.append(there[:3, 3] - found.T_camera_target[:3, 3], turn)
    np.testing.assert_allclose(found.covariance, np.outer(moved, moved), rtol=0.0, atol=2e-3 * (moved @ moved))


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
        (cause,), site, nodes = loads.every(Touching), self.stage.site, self.stage.tumour_vertices
        depth = np.maximum((cause.pose[:, 0, :3, 3] - site.origin) @ site.axis, 0.0)
        moved = np.broadcast_to(depth[:, None, None] * site.axis, (len(depth), len(nodes), 3))
        return predicted(moved, nodes, loads, [False] * len(depth), 0.0, np.full((2, len(depth)), np.nan), "")


def test_tool_error_is_of_a_deeper_tool_and_each_start_the_last():
    stage = template_theatre().stage(find_scene("palpate"))
    sinking, pose = Sinking(stage), np.eye(4)
    pose[:3, 3] = stage.site.origin
    first = ToolMotion(stage, sinking).under(pose, np.diag([1e-6, 1e-8, 1e-8]))
    assert first.moved == pytest.approx(0.0, abs=1e-9) and first.tool == pytest.approx(1.96e-3, rel=1e-3)
    ToolMotion(stage, sinking).under(pose, 1e-6 * np.eye(3), first)
    assert sinking.starts[0] is None and sinking.starts[2] is first.answer


@pytest.mark.parametrize(("bound", "expected", "doubt"), [(3e-4, 3e-4, ""), (np.inf, 0.0, UNBOUND)])
def test_model_error_without_a_bound_is_the_models_own(bound, expected, doubt, monkeypatch):
    model = SimpleNamespace(bound=bound)
    monkeypatch.setattr("scenes.tracked.tool_motion.answering", lambda deformer, answer: model)
    stage = template_theatre().stage(find_scene("palpate"))
    found = ToolMotion(stage, Sinking(stage)).under(np.eye(4), np.zeros((3, 3)))
    assert (found.model, found.doubt) == (expected, doubt)


def test_summary_counts_tumours_beyond_their_band_by_1_mm():
    known = [SimpleNamespace(relied=row < 3, band=2e-3) for row in range(4)]
    errors = [Off(1.0, 0.9, 1e-3, worst, worst <= 2e-3) for worst in (1.9e-3, 2.9e-3, 3.1e-3, 9e-3)]
    found = summary(known, errors)
    assert (found["pictures"], found["wrong"]) == (3, 1) and found["held_percent"] == pytest.approx(100.0 / 3.0)


def test_rows_of_an_overlay_are_in_millimetres(tmp_path):
    names = ("tracking", "camera", "registration", "tool", "model", "shutter")
    parts = {name: 1e-3 * (number + 7) for number, name in enumerate(names)}
    known = SimpleNamespace(
        camera=0,
        motion=Motion(np.zeros(0), True, 4e-3, 3e-3, 4e-3),
        band=6e-3,
        parts=parts,
        time=1.0,
        state=State.GOOD,
        words="",
    )
    shown = Shown(known, np.zeros(0), 0.013, 1e-3 * np.arange(1, 4), 0.014)
    write_rows(tmp_path / "rows.csv", [shown], [Off(15.0, 16.0, 17e-3, 18e-3, True)])
    cells = (tmp_path / "rows.csv").read_text().splitlines()[1].split(",")
    assert [float(cell) for cell in cells[2:16] + cells[17:21]] == pytest.approx([*range(1, 19)])


def test_outline_error_is_the_same_both_ways():
    """A drawn tumour that is a small piece of the true one, and a true one that is a small piece of the drawn one."""
    stage = template_theatre().stage(find_scene("palpate"))
    rest, calibration, truth = stage.tumour_at_rest.vertices, follower_of(stage).calibration, truth_of(stage)
    small, outlines = rest[:1] + 0.2 * (rest - rest[:1]), []
    for drawn, true in ((small, rest), (rest, small)):
        motion = Motion(stage.anatomy.mesh.nodes.copy())
        motion.positions[stage.tumour_vertices] = drawn
        camera, moved = calibration.camera(truth.T_camera_scan[0]), np.tile(true - rest, (len(truth.times), 1, 1))
        known = Known(truth.times[0], State.GOOD, "", Tracked(0, {}, {}, {}), motion, camera)
        outlines.append(off(known, replace(truth, displacement=moved), calibration, stage).outline)
    assert outlines[0] == pytest.approx(outlines[1]) and outlines[0] > 10.0


def test_pose_between_samples_weighs_their_covariances():
    stream = stream_of(np.array([0.0, 0.04]), np.tile(np.eye(4), (2, 1, 1)), np.stack([np.eye(6), 4.0 * np.eye(6)]))
    np.testing.assert_allclose(stream.at(0.01).covariance, (0.75**2 + 4.0 * 0.25**2) * np.eye(6), atol=1e-12)


def test_agreement_keeps_the_last_30_places_that_are_known():
    found, body = Agreement(), Pose(np.eye(4), np.zeros((6, 6)), 0.0, 4)
    for number in range(80):
        deviation = 3e-3 if number % 2 else 1e-3
        found = found.seen("tool", Pose(shifted(1e-5 * number), deviation**2 * np.eye(6), 0.0, 4), body, None)
    np.testing.assert_allclose(found.places["tool"][:, 0], 1e-5 * np.arange(20, 80, 2))


def looking(motion, **given):
    """Return what is known of pictures every 40 ms: `motion` moves the reference before the camera, from the first."""
    follower = replace(follower_of(template_theatre().stage(find_scene("palpate"))), tool=None, **given)
    first = truth_of(follower.motion.stage).T_camera_scan[0] @ np.linalg.inv(follower.registration.T_patient_scan)
    seen = [Tracked(0, {}, {PATIENT: Pose(T @ first, np.zeros((6, 6)), 0.0, 4)}, {}) for T in motion]
    vars(follower)["tracker"] = SimpleNamespace(track=lambda grey, before: seen[int(grey[0, 0])])
    known = [None]
    for number in range(len(motion)):
        known.append(follower.step(np.full((1, 1), number, np.uint8), 0.04 * number, known[-1]))
    return follower, known[1:]


def test_pace_is_across_the_view_and_fades_in_seconds():
    """10 mm along the view, then 10 mm across it, then nothing: each in 40 ms."""
    _, known = looking([shifted(0.0), shifted(0.0, 0.01), shifted(0.01, 0.01), shifted(0.01, 0.01)])
    assert [each.pace for each in known] == [None, *(pytest.approx(pace) for pace in (0.0, 0.25, 0.25 * 0.1**0.04))]


def test_band_has_no_registration_error_along_the_view():
    follower, (known,) = looking([np.eye(4)])
    scan, view = follower.registration, known.camera.T_camera_world[:3]
    sight = view @ [*follower.motion.stage.tumour_at_rest.vertices.mean(axis=0), 1.0]
    sight = scan.T_patient_scan[:3, :3] @ view[:, :3].T @ sight
    for error, expected in ((sight, 0.0), (np.cross(sight, PARTS), 2.4477e-3)):
        own = six(1e-6 * np.outer(error, error) / (error @ error))
        _, (known,) = looking([np.eye(4)], registration=replace(scan, covariance=own))
        assert known.parts["registration"] == pytest.approx(expected, rel=1e-4, abs=1e-7)


def test_calibration_error_is_what_the_pose_leaves_of_it():
    """A focal length that is 0.2 % off: the pose is fitted again, and a place beside the target is seen elsewhere."""
    T, corners, place = turned("x", 25.0), patient_reference().faces[0].corners, np.array([0.1, 0.05, 0.03])
    T[:3, 3], own = (0.0, 0.02, 0.4), np.zeros((9, 9))
    own[:2, :2] = 4.0
    right, wrong = (np.array([[focal, 0.0, 400.0], [0.0, focal, 300.0], [0.0, 0.0, 1.0]]) for focal in (1e3, 1002.0))
    turn, shift = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3].copy()
    pixels = cv2.projectPoints(corners, turn, shift, right, None)[0]
    again = cv2.solvePnP(corners, pixels, wrong, None, turn.copy(), shift.copy(), True)[1:]
    seen = [cv2.projectPoints(place, *pose, K, None)[0] for pose, K in (((turn, shift), right), (again, wrong))]
    expected = np.linalg.norm(seen[1] - seen[0]) / 1e3 * (T[:3, :3] @ place + T[:3, 3])[2]
    found = calibration_error(Camera(right, np.eye(4), 800, 600), T, corners, place, own)
    assert np.sqrt(np.trace(found)) == pytest.approx(expected, rel=0.1)
