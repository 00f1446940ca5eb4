"""Points on and inside the tumour that a live link sends."""

from dataclasses import replace

import numpy as np
import pytest
from links import NAMES, NOW, linked, peers, played

from scenes.link.frame import HEADER
from scenes.link.messages import encode_points, encode_transform, read_points
from scenes.link.outgoing import ResultEncoder
from scenes.link.pose_responder import NO_TARGETS, PoseResult
from scenes.tracked.follower import TrackingResult, TumourState
from scenes.tracked.tool_motion import BrainMotion
from sim.loads import Loads, Touching
from surrogate.model.learned import build_prediction


def test_points_inside_the_tumour_follow_volume_interpolation(stage):
    anatomy, outgoing = stage.anatomy, ResultEncoder(stage)
    rest = anatomy.mesh.nodes
    inner = np.setdiff1d(anatomy.tumour_nodes, anatomy.tumour_surface)
    tets = anatomy.mesh.tets[np.isin(anatomy.mesh.tets, anatomy.tumour_nodes).all(axis=1)]
    at = rest[tets[np.isin(tets, inner).any(axis=1)][:3]].mean(axis=1)
    # A stretch is no rigid motion and is linear: the volume's interpolation is exact, a surface point's is not.
    stretched = stage.drawn_vertices, 0.3 * (rest[stage.drawn_vertices] - rest[stage.drawn_vertices].mean(axis=0))
    moved = TrackingResult(0.0, TumourState.GOOD, "", NO_TARGETS, motion_of(rest, *stretched), bound=1e-3)
    assert len(at) == 3
    body = outgoing.build_messages(PoseResult(NOW, moved), outgoing.attach_points(["a", "b", "c"], at))[-2]
    found = 1e-3 * read_points(body[HEADER.size :])[1]
    assert found == pytest.approx(at + 0.3 * (at - rest[stage.drawn_vertices].mean(axis=0)), abs=1e-6)
    # A place on the cortex is not sent for a model that knows the tumour alone.
    tumour = replace(moved, motion=motion_of(rest, anatomy.tumour_nodes, 0.0 * rest[anatomy.tumour_nodes]))
    both = outgoing.attach_points(["a", "c"], np.vstack([at[:1], rest[anatomy.open_surface[:1, 0]]]))
    assert read_points(outgoing.build_messages(PoseResult(NOW, tumour), both)[-2][HEADER.size :])[0] == ["a"]


def motion_of(rest, nodes, displacement):
    positions = rest.copy()
    positions[nodes] += displacement
    nothing = Loads((Touching(np.eye(4)[None, None]),))
    answer = build_prediction(displacement[None], nodes, nothing, [False], 0.0, np.full((2, 1), np.nan), "")
    return BrainMotion(positions, True, solution=answer)


def test_link_moves_tumour_points_and_rejects_large_messages(follower, registration, truth, beside):
    rest = 1e3 * follower.motion.stage.tumour_at_rest.vertices

    async def scene():
        async with linked(follower, registration) as port, peers(port, 1) as (tracker,):
            tracker.send("POINT", "P", bytes(136 * 10**6))
            assert "too long" in await tracker.said()
            tracker.send("POINT", "P", encode_points(["a"], rest[:1] + 100.0))
            assert "nor on open cortex" in (said := await tracker.said()) and ": a 1" in said
            mixed = np.vstack([rest[:1], rest[:2] + 100.0, rest[1:2]])
            tracker.send("POINT", "P", encode_points(["a", "", "far", "b"], mixed))
            assert "number 2 1" in (said := await tracker.said()) and "far 1" in said and "others are followed" in said
            tracker.send("TRANSFORM", NAMES.tool, encode_transform(beside[10]), NOW)
            while not len(body := (await tracker.next("POINT", "PointsNow"))[1]):
                pass
            names, found = read_points(body)
            assert names == ["a", "b"] and found == pytest.approx(rest[:2] + 1e3 * truth.displacement[10, :2], abs=1e-2)

    played(scene())
