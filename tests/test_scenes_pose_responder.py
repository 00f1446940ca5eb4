"""Solutions that a live link computes for poses, and the doubts that it reports."""

from dataclasses import replace

import numpy as np
import pytest
from links import NAMES, NOW, corners_of, in_mm, linked, peers, played

from ar.overlay.gauge import Gauge
from scenes.link.messages import encode_points, transform
from scenes.link.pose_responder import NO_TARGETS, PoseResult, add_lateness
from scenes.tracked.follower import TrackingResult, TumourState
from scenes.tracked.tool_motion import BrainMotion


def test_the_tumour_comes_where_it_is_with_the_time_of_its_pose(follower, registration, truth, beside):
    row, stamp = 10, NOW + 12345
    expected = 1e3 * (follower.motion.stage.tumour_at_rest.vertices + truth.displacement[row])

    async def scene():
        async with linked(follower, registration, stale=0.5) as port, peers(port, 3) as (tracker, slicer, other):
            header, body = await slicer.next("POLYDATA", "TumourInScan")
            rest = corners_of(body)
            assert rest == pytest.approx(1e3 * follower.motion.stage.tumour_at_rest.vertices, abs=1e-3)
            tracker.send("TRANSFORM", "ProbeToTracker", transform(beside[row]), NOW)
            while "no StylusTipToReference yet; other transforms received: ProbeToTracker" not in await slicer.said(
                "Sulcus"
            ):
                pass
            tracker.send("TRANSFORM", NAMES.tool, transform(beside[row]), stamp)
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
def test_a_pose_that_is_none_is_refused_and_counted(follower, registration, beside, change, why):
    async def scene():
        async with linked(follower, registration) as port, peers(port, 1) as (tracker,):
            tracker.send("TRANSFORM", NAMES.tool, transform(change(beside[10])), NOW)
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
        own = None if sent else replace(registration, scanned=None)
        async with linked(follower, own) as port, peers(port, 1) as (tracker,):
            if sent:
                assert "no ReferenceToRas yet" in await tracker.said("Sulcus")
                tracker.send("TRANSFORM", NAMES.registration, transform(into), NOW)
            tracker.send("POINT", "P", encode_points(["a"], 1e3 * follower.motion.stage.tumour_at_rest.vertices[:1]))
            tracker.send("TRANSFORM", NAMES.tool, transform(beside[10]), NOW)
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
            tracker.send("TRANSFORM", NAMES.tool, transform(beside[10]), NOW)
            await tracker.next("TRANSFORM", "TumourToRas")
            for number, (away, good) in enumerate(((500.0, True), (9000.0, False)), 1):
                far = beside[10].copy()
                far[2, 3] += away
                tracker.send("TRANSFORM", NAMES.tool, transform(far), NOW + number)
                while (found := await tracker.next("STRING", "TipToTumour"))[0].stamp != NOW + number:
                    pass
                words = found[1][4:].decode()
                assert ("+-" in words) == good and ("m from the head, which is not plausible" in words) != good

    played(scene())


@pytest.mark.parametrize("state", [TumourState.GOOD, TumourState.UNSURE])
def test_an_answer_with_a_bound_is_stale_when_it_is_old(stage, state):
    known = TrackingResult(0.0, state, "words", NO_TARGETS, BrainMotion(stage.anatomy.mesh.nodes), band=1e-3)
    assert add_lateness(PoseResult(NOW, known), 0.2, 0.3).known is known
    old = add_lateness(PoseResult(NOW, known, Gauge(np.zeros(3), np.ones(3))), 0.4, 0.3)
    assert (
        old.known.state is TumourState.STALE and old.known.band is old.gauge is None and "0.4 s old" in old.known.words
    )


def test_a_tool_where_none_can_be_is_doubtful(follower, registration, beside):
    far = beside[10].copy()
    far[:3, 3] += 1000.0

    async def scene():
        async with linked(follower, registration) as port, peers(port, 1) as (tracker,):
            tracker.send("TRANSFORM", NAMES.tool, transform(far), NOW)
            while not len(corners_of((await tracker.next("POLYDATA", "TumourDoubtful"))[1])):
                pass
            assert "mm from the head" in (await tracker.next("STRING", "TipToTumour"))[1].decode()

    played(scene())
