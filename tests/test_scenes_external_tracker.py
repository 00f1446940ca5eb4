"""External trackers: interpolated poses, clock offset, daily clocks, and the camera's calibration error."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from theatres import template_theatre

from ar.optics.lens import Lens
from ar.tracking import pose_stream
from ar.tracking.image_sequences import read_video
from ar.tracking.pose import Pose, PoseStatus
from ar.tracking.pose_stream import Clock, build_pose_stream, estimate_clock_offset
from ar.tracking.rigid import move_rigidly
from ar.tracking.targets import build_patient_reference
from scenes.cli import main
from scenes.script.scene import find_scene
from scenes.tracked.agreement import Agreement
from scenes.tracked.calibration_file import (
    read_calibration,
    read_hand_eye,
    read_intrinsic_covariance,
    write_exact_intrinsics,
)
from scenes.tracked.external_tracker import CameraMount, ExternalTracker
from scenes.tracked.follower import Follower, TumourState
from scenes.tracked.overlay_painter import format_top_lines
from scenes.tracked.overlay_text import format_overlay_error
from scenes.tracked.plausible import describe_tool_penetration
from scenes.tracked.pose_file import TrackedPose, read_pose_stream, write_poses
from scenes.tracked.registration_file import read_registration
from scenes.tracked.run import read_timed_images
from scenes.tracked.tool_motion import ToolMotion
from scenes.tracked.tracked_tool import read_tool
from scenes.tracked.truth import read_truth
from sim.errors import InputError

FILM = Path(__file__).parent / "data" / "film"
TRACKER = move_rigidly(np.eye(4), np.zeros(3), np.array([0.3, -0.2, 1.1, 0.5, -0.7, 1.2]))
"""T_tracker_scan."""
NOISE = np.diag(np.repeat([1e-4**2, 3e-4**2], 3))
NONE = np.zeros((6, 6))
DAY, AHEAD = pose_stream.DAY_SECONDS, pose_stream.MAX_EXTRAPOLATION


def swung(time):
    """A tool in a quick hand: 20 mm and 11 degrees to and fro, 1.2 times a second."""
    phase = 2.0 * np.pi * 1.2 * time
    step = [0.02 * np.sin(phase), 0.01 * np.sin(0.7 * phase), 0.0, 0.0, 0.2 * np.sin(phase + 1.0), 0.1 * np.cos(phase)]
    return move_rigidly(TRACKER, np.zeros(3), np.array(step))


def sampled(pose_at, times, rng=None, offset=0.0):
    """A stream of what happens at times, with noise; its stamps are those times and an offset."""
    poses = [pose_at(time) for time in times]
    if rng is not None:
        poses = [move_rigidly(T, np.zeros(3), rng.multivariate_normal(np.zeros(6), NOISE)) for T in poses]
    return build_pose_stream(
        np.asarray(times) + offset, np.stack(poses), np.tile(NONE if rng is None else NOISE, (len(times), 1, 1))
    )


def twist(found, true):
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).as_rotvec()
    return np.concatenate([found[:3, 3] - true[:3, 3], turn])


@pytest.mark.parametrize(("rate", "late"), [(20.0, 0.08), (30.0, 0.05), (60.0, 0.03)])
def test_pose_interpolation_is_closer_than_newest_sample(rate, late):
    rng = np.random.default_rng(int(rate))
    stream = sampled(swung, np.arange(0.0, 4.0, 1.0 / rate), rng)
    plain, found, inside = [], [], []
    for time in rng.uniform(0.5, 3.5, 300):
        pose, true = stream.interpolate(time), swung(time)
        off = twist(pose.T_camera_target, true)
        inside.append(off @ np.linalg.solve(pose.covariance, off) <= chi2.ppf(0.95, 6))
        found.append(np.linalg.norm(off[:3]))
        newest = stream.poses[np.searchsorted(stream.times, time - late) - 1]  # that has come by then
        plain.append(np.linalg.norm(newest[:3, 3] - true[:3, 3]))
    assert np.median(plain) > 3e-3 and np.median(found) < 0.05 * np.median(plain)
    assert np.percentile(found, 95) < (8e-4 if rate < 30.0 else 4e-4)
    assert np.mean(inside) > 0.93


def test_pose_extrapolation_ends_after_a_time_limit():
    times = np.concatenate([np.arange(0.0, 1.0, 0.04), np.arange(1.3, 2.0, 0.04)])
    stream = sampled(swung, times)
    last = times[times < 1.0][-1]
    on, beyond = stream.interpolate(last + 0.9 * AHEAD), stream.interpolate(last + 1.1 * AHEAD)
    assert beyond is None and on is not None
    off = twist(on.T_camera_target, swung(last + 0.9 * AHEAD))
    assert off @ np.linalg.solve(on.covariance, off) <= chi2.ppf(0.95, 6)
    assert np.trace(on.covariance) > 2.0 * np.trace(stream.interpolate(0.5).covariance)
    assert stream.interpolate(-0.01) is None and stream.compute_age(-0.01) == np.inf and stream.interpolate(1.2) is None
    assert stream.interpolate(1.3) is not None and stream.interpolate(1.31) is not None
    assert stream.interpolate(1.3 - 5e-5) is not None and stream.interpolate(1.29) is None  # files round times
    assert stream.compute_age(1.2) == pytest.approx(1.2 - last) and pose_stream.MAX_GAP < 0.3
    older = ExternalTracker(stream, sampled(swung, times[:10]))
    assert older.compute_age(2.5) == pytest.approx(2.5 - times[9])
    with pytest.raises(ValueError, match="pose 3 is not later"):
        build_pose_stream(np.array([0.0, 2.0, 1.0]), np.tile(np.eye(4), (3, 1, 1)), np.tile(NONE, (3, 1, 1)))


def test_daily_clock_continues_at_midnight():
    times = np.arange(0.0, 2.0, 0.025)
    stamps = (times + DAY - 1.0) % DAY
    stream = build_pose_stream(stamps, np.stack([swung(time) for time in times]), np.tile(NONE, (len(times), 1, 1)))
    for time in (0.4, 1.5):
        for days in (-DAY, 0.0, DAY):
            pose = stream.interpolate(time + DAY - 1.0 + days)
            np.testing.assert_allclose(pose.T_camera_target, swung(time), atol=5e-4)
    epoch = sampled(swung, times, offset=1.7e9)  # seconds since 1970: other days are other times
    assert epoch.interpolate(1.7e9 + 0.5) is not None and epoch.interpolate(1.7e9 + 0.5 + DAY) is None


def test_clock_offset_from_motion_has_a_valid_error():
    rng, off = np.random.default_rng(4), []
    samples = np.arange(0.0, 5.0, 1.0 / 40.0)
    others = np.stack([swung(time)[:3, 3] for time in samples])
    for true in rng.uniform(-0.9, 0.9, 60):
        times = np.arange(1.0, 4.0, 0.1)
        places = np.stack([swung(time + true)[:3, 3] for time in times]) + 2e-4 * rng.normal(size=(30, 3)) + 0.05
        clock = estimate_clock_offset(times, places, samples, others + 1e-4 * rng.normal(size=others.shape))
        off.append((clock.offset - true) / clock.error)
        assert abs(clock.offset - true) < 2e-3
    assert 0.7 < np.std(off) < 1.5
    still = np.tile(others[:1], (len(samples), 1)) + 1e-5 * rng.normal(size=others.shape)
    with pytest.raises(ValueError, match="Move the tool"):
        estimate_clock_offset(times, places[:1] + 1e-5 * rng.normal(size=places.shape), samples, still)
    turned = np.stack([[np.sin(6.0 * np.pi * t), 0.0, 0.0] for t in samples])
    with pytest.raises(ValueError, match="more than one offset"):
        estimate_clock_offset(times, np.stack([[np.sin(6.0 * np.pi * t), 0.0, 0.0] for t in times]), samples, turned)
    with pytest.raises(ValueError, match="images show what the poses have"):
        estimate_clock_offset(times[:3], places[:3], samples, others)
    with pytest.raises(ValueError, match="end before the images"):
        estimate_clock_offset(3.0 * times, places, samples, others)
    some = np.abs(samples - 2.5) > 0.06
    with pytest.raises(ValueError, match="gaps of more than"):
        estimate_clock_offset(times, places, samples[some], others[some])


@pytest.fixture(scope="module")
def bodies(stage):
    """Where tool and reference are in the tracker's frame at a time of the film; the head sways."""
    registration, tool = read_registration(FILM / "registration.json"), read_tool(FILM / "tool.json")
    scene = find_scene("palpate")

    def head(time):
        return move_rigidly(TRACKER, np.zeros(3), np.array([0.0, 2e-3 * np.sin(4.0 * time), 0.0, 0.0, 0.0, 0.0]))

    return {
        "tool": lambda time: (
            head(time) @ scene.compute_pose(stage.site, scene.path(time)) @ np.linalg.inv(tool.T_cube_tool)
        ),
        "patient": lambda time: head(time) @ np.linalg.inv(registration.T_patient_scan),
        "head": head,
    }


@pytest.fixture(scope="module")
def follower(stage):
    read = read_registration(FILM / "registration.json"), read_tool(FILM / "tool.json")
    return Follower(read_calibration(FILM / "camera.yaml"), *read, ToolMotion(stage))


def tips(follower, elsewhere, truth):
    """How far off the tool's tip is in the scan [m], and deviations, where it is known."""
    out = []
    for row, time in enumerate(truth.times):
        if (beside := elsewhere.find_tool_pose(time)) is not None:
            there = (follower.registration.T_patient_scan @ [*truth.T_scan_tool[row][:3, 3], 1.0])[:3]
            place, spread = beside.transform_point(follower.tool.T_cube_tool[:3, 3])
            out.append((np.linalg.norm(place - there), np.sqrt(np.trace(spread))))
    return np.array(out).T


def test_tool_pose_in_video_matches_external_tracker(follower, stage, bodies):
    truth = read_truth(FILM / "truth.npz", stage.anatomy.digest, len(stage.tumour_vertices))
    rng, late = np.random.default_rng(0), 0.06
    times = np.arange(-0.5, 3.5, 1.0 / 30.0)
    streams = [sampled(bodies[name], times, rng, DAY - 1.0 + late) for name in ("tool", "patient")]
    right = ExternalTracker(*streams, Clock(DAY - 1.0 + late, 2e-3))
    wrong = replace(right, clock=Clock(DAY - 1.0))
    (off, spread), (late_off, _) = tips(follower, right, truth), tips(follower, wrong, truth)
    assert len(off) == len(truth.times) and off.max() < 6e-4 and (off < 3.0 * spread).all()
    assert late_off.max() > 5e-4 and late_off.max() > 2.0 * off.max()
    eye = CameraMount(np.linalg.inv(truth.T_camera_scan[0] @ np.linalg.inv(bodies["head"](0.0))), 1e-2 * NOISE)
    looked = replace(right, mount=eye).find_reference_pose(0.0)
    true = truth.T_camera_scan[0] @ np.linalg.inv(follower.registration.T_patient_scan)
    step = twist(looked.T_camera_target, true)
    assert np.linalg.norm(step[:3]) < 1e-3 and step @ np.linalg.solve(looked.covariance, step) < chi2.ppf(0.999, 6)
    riding = replace(eye, poses=sampled(lambda time: np.eye(4), times, offset=DAY - 1.0 + late))
    found = replace(right, mount=riding).find_reference_pose(0.0)
    np.testing.assert_allclose(found.T_camera_target, looked.T_camera_target)


def test_image_without_external_poses_is_stale(follower, bodies):
    times = np.arange(0.0, 0.45, 0.025)
    other = ExternalTracker(*(sampled(bodies[name], times) for name in ("tool", "patient")))
    one, known, said = replace(follower, external=other), None, []
    one = replace(one, motion=replace(one.motion, deformer=Still()))
    for each in read_timed_images(read_video(FILM / "film.mp4", 30.0)):
        if each.source.time > 0.9:
            break
        known = one.track(each.source.grey, each.source.time, known)
        said.append((known.state, known.warning))
    assert [state for state, _ in said[:4]] == [TumourState.REST] * 4
    assert said[5] == (TumourState.NO_TOOL, "tool stale, no pose for 0.2 s: the tumour as 0.3 s ago")
    assert said[4][0] is TumourState.NO_REFERENCE  # the film is over-exposed there


def followed(follower, other, until=1.0):
    """What is known of the film's first pictures, by another tracker, and with a brain that does not move."""
    one, known, out = replace(follower, external=other), None, []
    one = replace(one, motion=replace(one.motion, deformer=Still()))
    for each in read_timed_images(read_video(FILM / "film.mp4", 30.0)):
        if each.source.time > until:
            break
        known = one.track(each.source.grey, each.source.time, known)
        out.append(known)
    return [known for known in out if known.state is not TumourState.NO_REFERENCE]


def test_external_poses_are_compared_with_visible_targets(follower, bodies, stage):
    times = np.arange(-0.5, 3.5, 0.025)
    tool, patient = (sampled(bodies[name], times) for name in ("tool", "patient"))
    right = ExternalTracker(tool, patient)
    known = followed(follower, right)
    assert {each.state for each in known} <= {TumourState.GOOD, TumourState.REST} and len(known) > 5
    np.testing.assert_allclose(known[-1].agreement.positions["tool"], 0.0, atol=1.5e-3)
    for each in followed(follower, right.swapped_tracker):
        assert each.state is TumourState.UNSURE and each.bound is None
        assert "mm from its poses: are the two files of --poses swapped?" in each.warning
    aside = move_rigidly(
        np.eye(4), np.zeros(3), np.array([0.05, 0.0, -0.03, 0.4, 0.0, 0.0])
    )  # bodies beside their cubes
    mounted = replace(right, tool_poses=sampled(lambda time: bodies["tool"](time) @ aside, times))
    assert all(each.is_reliable for each in followed(follower, mounted))
    far = replace(
        right,
        tool_poses=sampled(
            lambda time: (
                bodies["tool"](time) @ move_rigidly(np.eye(4), np.zeros(3), np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]))
            ),
            times,
        ),
    )
    assert "is seen 400 mm from its poses" in followed(follower, far, 0.2)[-1].warning
    quick = replace(right, tool_poses=sampled(lambda time: bodies["tool"](0.8 + 8.0 * (time - 0.8)), times))
    assert "moves by" in followed(follower, quick)[-1].warning
    eye = CameraMount(np.linalg.inv(truth_of_camera(stage) @ np.linalg.inv(bodies["head"](0.0))), NOISE)
    looked = replace(right, mount=eye)
    agreed = looked.compare_targets(0.0, known[0].targets.poses, Agreement())
    assert not agreed.inconsistency and set(agreed.positions) == {"patient", "tool"}
    assert "swapped" in looked.swapped_tracker.compare_targets(0.0, known[0].targets.poses, Agreement()).inconsistency


def truth_of_camera(stage):
    return read_truth(FILM / "truth.npz", stage.anatomy.digest, len(stage.tumour_vertices)).T_camera_scan[0]


def test_clock_difference_of_external_poses_is_reported(follower, bodies):
    times = np.arange(-0.5, 3.5, 0.025)
    tool, patient = (
        sampled(bodies[name], times, offset=offset) for name, offset in (("tool", 0.0), ("patient", 100.0))
    )
    last = followed(follower, ExternalTracker(tool, patient), 0.2)[-1]
    assert last.state is TumourState.NO_TOOL
    assert last.warning.startswith("tool not known, the patient's poses begin 99.4 s after this image (see --clock)")
    late = followed(follower, ExternalTracker(tool, replace(patient, times=times - 100.0)), 0.2)[-1]
    assert "the patient's poses end 96." in late.warning
    assert (
        followed(follower, ExternalTracker(tool, patient, Clock(100.0)), 0.2)[-1].warning.count(
            "the tool's poses end 96."
        )
        == 1
    )


def test_tool_pose_deep_in_the_brain_is_reported(stage, follower):
    nodes = stage.anatomy.mesh.nodes
    pose = np.eye(4)
    pose[:3, 3] = nodes.mean(axis=0)
    pose[:3, 2] *= -1.0
    pose[:3, 0] *= -1.0
    assert "tip would be" in describe_tool_penetration(follower.tool, pose, stage)
    away = pose @ follower.tool.T_cube_tool  # markers in the middle of the brain
    assert "markers would be" in describe_tool_penetration(follower.tool, away, stage)
    pose[:3, 3] = stage.site.origin + 0.02 * stage.site.axis  # a tip 20 mm into the opening
    pose[:3, :3] = np.column_stack([stage.site.right, stage.site.up, -stage.site.axis])
    assert not describe_tool_penetration(follower.tool, pose, stage)


class Still:
    """A deformer of a brain that does not move."""

    def deform(self, loads, start=None, at=None):
        from scenes.tracked.rendered_video import DentDeformer

        found = DentDeformer(template_theatre().anatomy, template_theatre().site).deform(loads)
        return replace(found, displacement=0.0 * found.displacement)


def written(path, stream):
    rows = [
        TrackedPose(time % DAY, PoseStatus.GOOD, Pose(T, covariance, 0.0, 0), 0.0)
        for time, T, covariance in zip(stream.times.tolist(), stream.poses, stream.covariances, strict=True)
    ]
    write_poses(path, rows, np.zeros(3))
    return str(path)


def test_overlay_command_estimates_clock_of_pose_files(bodies, tmp_path, capsys):
    times, rng = np.arange(-0.5, 3.5, 0.025), np.random.default_rng(2)
    streams = ((name, sampled(bodies[name], times, rng, DAY - 1.0)) for name in ("tool", "patient"))
    files = [written(tmp_path / f"{name}.csv", stream) for name, stream in streams]
    again = read_pose_stream(files[0])
    assert again.has_daily_clock and again.times[-1] > DAY and again.covariances[0, 0, 0] == pytest.approx(1e-8)
    given = ["--camera", str(FILM / "camera.yaml"), "--registration", str(FILM / "registration.json")]
    words = ["overlay", str(FILM / "film.mp4"), *given, "--tool", str(FILM / "tool.json"), "--poses", *files]
    quick = ["--deformer", "rest", "--device", "cpu", "--json"]
    assert main([*words, "--clock", "auto", *quick]) == 1  # nobody says how the brain moved
    out, err = capsys.readouterr()
    said = json.loads(out)
    assert said["tool_seen_percent"] == said["reference_seen_percent"] > 70.0
    assert said["states"][TumourState.UNKNOWN.value] == 11
    offset, error = (float(part.split()[0]) for part in (err.split("clock runs ")[1], err.split("+- ")[1]))
    assert abs(offset - (DAY - 1.0)) < 5.0 * error < 0.05
    for more, why in (
        (["--clock", "soon"], "give seconds"),
        (["--camera-poses", files[0]], "give --hand-eye"),
        (["--hand-eye", files[0]], "hand-eye calibration"),
    ):
        assert main([*words, *more]) == 2
        assert why in capsys.readouterr().err
    assert main([*words[:-3], "--clock", "1"]) == 2 and "give --poses, too" in capsys.readouterr().err
    stored = {"rotation": np.eye(3).tolist(), "shift_mm": [1.0, 2.0, 3.0], "rms_degrees": 0.1, "rms_mm": 0.5}
    (tmp_path / "h.json").write_text(json.dumps(stored))
    X, covariance = read_hand_eye(tmp_path / "h.json")
    assert X[1, 3] == pytest.approx(2e-3) and covariance[0, 0] == pytest.approx(2.5e-7)
    (tmp_path / "h.json").write_text(json.dumps(stored | {"rotation": (2.0 * np.eye(3)).tolist()}))
    with pytest.raises(InputError, match="its rotation is none"):
        read_hand_eye(tmp_path / "h.json")


def test_calibration_error_in_band_unless_cancelled_by_reference(follower, stage, tmp_path):
    follower = replace(follower, motion=replace(follower.motion, deformer=Still()))
    first = next(iter(read_video(FILM / "film.mp4", 30.0)))
    deviations = np.array([2, 2, 2, 2, 5e-3, 0.05, 3e-4, 3e-4, 0.1])
    stored = {"format": "sulcus intrinsics 1", "covariance": np.diag(deviations**2).tolist()}
    (tmp_path / "k.json").write_text(json.dumps(stored))
    calibrated = replace(follower, intrinsic_covariance=read_intrinsic_covariance(tmp_path / "k.yaml"))
    known = calibrated.track(first.grey, 0.0)
    rng, off = np.random.default_rng(0), []
    reference = known.targets.poses["patient"].T_camera_target
    corners = build_patient_reference().faces[0].corners
    for step in deviations * rng.normal(size=(100, 9)):
        # What another camera would have seen, and what this one makes of it.
        focal, principal = (np.array(each) for each in (follower.calibration.focal, follower.calibration.principal))
        lens = Lens(*(np.ravel(follower.calibration.build_camera(np.eye(4)).distortion)[:5] + step[4:]))
        other = replace(
            follower.calibration, focal=(*(focal + step[:2]),), principal=(*(principal + step[2:4]),), lens=lens
        )
        pixels = other.build_camera(reference).project(corners)[0]
        middle = known.camera.to_camera_frame(stage.tumour_at_rest.vertices.mean(axis=0)[None])[0]
        tumour = np.linalg.inv(reference) @ [*middle, 1.0]
        camera = follower.calibration.build_camera(np.eye(4))
        fitted = fit(camera, corners, pixels, reference)
        seen, turned = fitted @ tumour, other.build_camera(reference)
        apart = camera.project(seen[None, :3])[0] - turned.project(tumour[None, :3])[0]
        off.append(apart[0] * seen[2] / focal)
    assert known.sources["camera"] == pytest.approx(
        2.448 * np.linalg.svd(np.cov(np.transpose(off)))[1][0] ** 0.5, rel=0.25
    )
    bare = follower.track(first.grey, 0.0)
    assert known.bound > known.sources["camera"] > 1e-4 and "camera" not in bare.sources
    assert format_top_lines(bare)[-1].startswith("error by tissue, camera and segmentation: not known")
    assert format_top_lines(known)[-1].startswith("error by tissue and segmentation: not known")
    write_exact_intrinsics(tmp_path / "k.json", follower.calibration)
    calibrated = replace(follower, intrinsic_covariance=read_intrinsic_covariance(tmp_path / "k.yaml"))
    exact = calibrated.track(first.grey, 0.0)
    assert exact.sources["camera"] == 0.0 and exact.bound == pytest.approx(bare.bound)
    assert "The camera is reported to be exactly known." in format_overlay_error(exact)
    (tmp_path / "k.json").write_text(json.dumps(stored | {"covariance": [[1.0]]}))
    with pytest.raises(InputError, match="none of 9 x 9"):
        read_intrinsic_covariance(tmp_path / "k.yaml")
    assert read_intrinsic_covariance(FILM / "camera.yaml") is None


def fit(camera, corners, pixels, start):
    turn, shift = cv2.Rodrigues(start[:3, :3])[0], start[:3, 3].reshape(3, 1).copy()
    turn, shift = cv2.solvePnPRefineLM(corners, pixels, camera.K, camera.distortion, turn, shift)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return T
