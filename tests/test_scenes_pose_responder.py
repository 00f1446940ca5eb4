"""Solutions of a live link for poses: camera pose, tumour position and warnings."""

from dataclasses import replace

import numpy as np
import pytest
from links import NAMES, NOW, corners_of, in_mm, linked, peers, played
from scipy.spatial.transform import Rotation

from ar.overlay.gauge import DistanceGauge
from scenes.commands.link import parse_address
from scenes.link.console import format_address
from scenes.link.frame import to_stamp
from scenes.link.messages import encode_points, encode_transform
from scenes.link.pose_responder import NO_TARGETS, PoseResult, interpolate_camera_pose, mark_late
from scenes.link.received_transforms import ReceivedTransforms, TransformNames
from scenes.tracked.follower import TrackingResult, TumourState
from scenes.tracked.tool_motion import BrainMotion
from sim.errors import InputError


def test_sent_tumour_has_the_position_and_time_of_its_pose(follower, registration, truth, beside):
    row, stamp = 10, NOW + 12345
    expected = 1e3 * (follower.motion.stage.tumour_at_rest.vertices + truth.displacement[row])

    async def scene():
        async with linked(follower, registration, stale=0.5) as port, peers(port, 3) as (tracker, slicer, other):
            header, body = await slicer.next("POLYDATA", "TumourInScan")
            rest = corners_of(body)
            assert rest == pytest.approx(1e3 * follower.motion.stage.tumour_at_rest.vertices, abs=1e-3)
            tracker.send("TRANSFORM", "ProbeToTracker", encode_transform(beside[row]), NOW)
            while "no StylusTipToReference yet; other transforms received: ProbeToTracker" not in await slicer.said(
                "Sulcus"
            ):
                pass
            tracker.send("TRANSFORM", NAMES.tool, encode_transform(beside[row]), stamp)
            for each in (slicer, other):
                while (found := await each.next("POLYDATA", "TumourNow"))[0].stamp != stamp:
                    pass
                assert corners_of(found[1]) == pytest.approx(expected, abs=2e-2)
                assert not len(corners_of((await each.next("POLYDATA", "TumourDoubtful"))[1]))
                # The film's truth says nothing of the cortex: it is not sent as if it were known.
                assert not len(corners_of((await each.next("POLYDATA", "CortexNow"))[1]))
                header, body = await each.next("TRANSFORM", "TumourToRas")
                T = np.eye(4)
                T[:3] = np.frombuffer(body, ">f4").reshape(4, 3).T
                assert header.stamp == stamp
                assert rest @ T[:3, :3].T + T[:3, 3] == pytest.approx(expected, abs=1.0)
                words = (await each.next("STRING", "TipToTumour"))[1][4:].decode()
                assert "+-" in words and "registration and model; not known of tissue and segmentation" in words
            # Its pose is old soon: then nothing is drawn as if it were known.
            while len(corners_of((await slicer.next("POLYDATA", "TumourNow"))[1])):
                pass
            while "no new StylusTipToReference for" not in await slicer.said("Sulcus"):
                pass
            assert b"not known: no new" in (await slicer.next("STRING", "TumourMotion"))[1]

    played(scene())


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda T: np.diag([1.0, 1.0, -1.0, 1.0]) @ T, "mirrors"),
        (lambda T: np.diag([1e-3, 1e-3, 1e-3, 1.0]) @ T, "scales"),
        (lambda T: np.full((4, 4), np.nan), "not finite"),
        (lambda T: np.eye(4), "identity"),
    ],
)
def test_invalid_pose_is_rejected_and_counted(follower, registration, beside, change, why):
    async def scene():
        async with linked(follower, registration) as port, peers(port, 1) as (tracker,):
            tracker.send("TRANSFORM", NAMES.tool, encode_transform(change(beside[10])), NOW)
            assert why in await tracker.said()
            while why not in (words := await tracker.said("Sulcus")):
                pass
            assert "no StylusTipToReference yet; rejected: 1 a matrix" in words or "the identity" in words
            assert not len(corners_of((await tracker.next("POLYDATA", "TumourNow"))[1]))

    played(scene())


@pytest.mark.parametrize("sent", [True, False])
def test_unverified_registration_is_used_with_warning(follower, registration, beside, truth, sent):
    into = in_mm(np.linalg.inv(registration.T_patient_scan))
    expected = 1e3 * (follower.motion.stage.tumour_at_rest.vertices + truth.displacement[10])

    async def scene():
        own = None if sent else replace(registration, scan=None)
        async with linked(follower, own) as port, peers(port, 1) as (tracker,):
            if sent:
                assert "no ReferenceToRas yet" in await tracker.said("Sulcus")
                tracker.send("TRANSFORM", NAMES.registration, encode_transform(into), NOW)
            tracker.send("POINT", "P", encode_points(["a"], 1e3 * follower.motion.stage.tumour_at_rest.vertices[:1]))
            tracker.send("TRANSFORM", NAMES.tool, encode_transform(beside[10]), NOW)
            while not len(found := corners_of((await tracker.next("POLYDATA", "TumourDoubtful"))[1])):
                pass
            assert found == pytest.approx(expected, abs=2e-2)
            for name in ("TipToTumour", "TumourMotion"):
                words = (await tracker.next("STRING", name))[1][4:].decode()
                assert "+-" in words or "placed within" in words
                assert "doubtful: not checked whose registration this is" in words
                assert ("not known of registration" in words) == sent
            assert not (await tracker.next("POINT", "PointsNow"))[1]
            assert len((await tracker.next("POINT", "PointsDoubtful"))[1]) == 136
            while "not checked whose registration" not in await tracker.said("Sulcus"):
                pass

    played(scene())


def test_distant_tool_is_marked_unreliable(follower, registration, beside):
    async def scene():
        async with linked(follower, registration) as port, peers(port, 1) as (tracker,):
            tracker.send("TRANSFORM", NAMES.tool, encode_transform(beside[10]), NOW)
            await tracker.next("TRANSFORM", "TumourToRas")
            for number, (away, good) in enumerate(((500.0, True), (9000.0, False)), 1):
                far = beside[10].copy()
                far[2, 3] += away
                tracker.send("TRANSFORM", NAMES.tool, encode_transform(far), NOW + number)
                while (found := await tracker.next("STRING", "TipToTumour"))[0].stamp != NOW + number:
                    pass
                words = found[1][4:].decode()
                assert ("+-" in words) == good and ("m from the head, which is not plausible" in words) != good

    played(scene())


@pytest.mark.parametrize("state", [TumourState.GOOD, TumourState.UNSURE])
def test_old_result_is_marked_stale_without_band(stage, state):
    known = TrackingResult(0.0, state, "words", NO_TARGETS, BrainMotion(stage.anatomy.mesh.nodes), bound=1e-3)
    assert mark_late(PoseResult(NOW, known), 0.2, 0.3).tracking is known
    old = mark_late(PoseResult(NOW, known, DistanceGauge(np.zeros(3), np.ones(3))), 0.4, 0.3)
    assert (
        old.tracking.state is TumourState.STALE
        and old.tracking.bound is old.gauge is None
        and "0.4 s old" in old.tracking.warning
    )


def test_implausible_tool_position_is_marked_doubtful(follower, registration, beside):
    far = beside[10].copy()
    far[:3, 3] += 1000.0

    async def scene():
        async with linked(follower, registration) as port, peers(port, 1) as (tracker,):
            tracker.send("TRANSFORM", NAMES.tool, encode_transform(far), NOW)
            while not len(corners_of((await tracker.next("POLYDATA", "TumourDoubtful"))[1])):
                pass
            assert "mm from the head" in (await tracker.next("STRING", "TipToTumour"))[1].decode()

    played(scene())


BEGUN, STEP = 1e9, 1.0 / 30.0
TUMOUR = np.array([0.02, -0.01, 0.4])
"""From the camera [m]."""


def camera(time):
    """A hand that sways by 20 mm and 4 degrees, once in 1.5 s: T (4, 4) [mm]."""
    T = np.eye(4)
    sway = np.sin(2.0 * np.pi * time / 1.5)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.0, 0.07 * sway, 0.0]).as_matrix(), [20.0 * sway, 0.0, 300.0]
    return T


def heard_of(times, stamped=True, sender=0):
    """A camera's transforms as they came, each 5 ms after its time."""
    names = TransformNames()
    heard = ReceivedTransforms(names, 0.3)
    for time in times:
        stamp = to_stamp(BEGUN + time) if stamped else 0
        heard = heard.add_transform(names.camera, camera(time), stamp, time + 5e-3, sender)
    return heard


def off(placed, time):
    """Distance of the tumour from its position in the image of a time [m]."""
    truth = camera(time)
    truth[:3, 3] *= 1e-3
    return np.linalg.norm(placed.T[:3, :3] @ TUMOUR + placed.T[:3, 3] - truth[:3, :3] @ TUMOUR - truth[:3, 3])


def at(heard, time, now=None, stamped=True):
    middle = camera(0.0)[:3, :3] @ TUMOUR + 1e-3 * camera(0.0)[:3, 3]
    stamp = to_stamp(BEGUN + time) if stamped else 0
    return interpolate_camera_pose(
        heard.list_transforms(heard.names.camera), time if now is None else now, stamp, middle, heard.max_age
    )


def test_interpolated_pose_reports_remaining_error():
    times = STEP * np.arange(40)
    heard = heard_of(times)
    for late, share in ((2, 0.5), (5, 0.3), (12, 0.9), (1, 0.6)):  # poses that came after the picture's
        time = times[-1 - late] + (share - 1.0) * STEP
        placed = at(heard, time)
        newest = replace(placed, T=heard.list_transforms(heard.names.camera)[-1].T)
        assert off(placed, time) <= placed.motion_error < 0.2e-3 and off(placed, time) < 0.1 * off(newest, time)
    ahead = at(heard, times[-1] + 0.03)
    assert off(ahead, times[-1] + 0.03) <= ahead.motion_error < 4e-3


def test_newest_pose_has_camera_motion_as_error():
    times = STEP * np.arange(12)
    middle = camera(0.0) @ [*1e3 * TUMOUR, 1.0]
    here, there = (np.linalg.inv(camera(time)) @ middle for time in times[-2:])
    way = 1e-3 * np.linalg.norm(here - there)
    for heard, time, stamped, apart in (
        (heard_of(times), times[-1] + 0.2, True, 0.2),
        (heard_of(times[-2:]), times[-1] - 0.5 * STEP, True, 0.5 * STEP),
        (heard_of(times, stamped=False), times[-1] + 0.02, False, 0.02 - 5e-3),
    ):
        placed = at(heard, time, stamped=stamped)
        assert np.allclose(placed.T[:3, :3], camera(times[-1])[:3, :3])
        assert placed.motion_error == pytest.approx(way * apart / STEP, rel=1e-4)
    assert at(heard_of(times), times[-1] + 1.0) == "no {name} within 0.3 s of the image's time"
    assert "alone" in at(heard_of(times[-1:]), times[-1])


def test_poses_of_other_client_or_clock_are_not_interpolated():
    heard = heard_of(STEP * np.arange(9))
    name = heard.names.camera
    taken_over = heard.add_transform(name, camera(0.4), to_stamp(BEGUN + 0.4), 1.0, 1)
    assert len(heard.list_transforms(name)) == 9 and len(taken_over.list_transforms(name)) == 1
    set_back = heard.add_transform(name, camera(0.4), to_stamp(BEGUN - 60.0), 0.4, 0)
    assert [sent.stamp for sent in set_back.list_transforms(name)] == [to_stamp(BEGUN - 60.0)]
    assert len(heard_of(STEP * np.arange(200)).list_transforms(name)) == 33


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("localhost", ("localhost", 18944)),
        ("plus.example:18945", ("plus.example", 18945)),
        ("192.0.2.7:", ("192.0.2.7", 18944)),
        ("[::1]:18945", ("::1", 18945)),
        ("[fe80::1%eth0]", ("fe80::1%eth0", 18944)),
        ("::1", ("::1", 18944)),
    ],
)
def test_parse_address_accepts_host_and_ipv6_in_brackets(text, address):
    assert parse_address(text) == address
    assert parse_address(format_address(*address)) == address


@pytest.mark.parametrize("text", ["", ":18944", "[::1", "[localhost]:3", "::1:99999", "host:65536", "host:x", "a:b:1"])
def test_parse_address_rejects_invalid_address(text):
    with pytest.raises(InputError, match="in brackets"):
        parse_address(text)
