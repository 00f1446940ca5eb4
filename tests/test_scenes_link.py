"""A live link: many clients, bad ones among them, and poses whose answers are known, over 127.0.0.1 and a free port."""

import asyncio
import socket
import time
from contextlib import asynccontextmanager, suppress
from dataclasses import replace

import numpy as np
import pytest
from films import FILM, truth_of
from links import HOST, NAMES, Peer, corners_of, in_mm, linked, peers, played

from ar.overlay.gauge import Gauge
from scenes.link import clients as limits
from scenes.link.answer import NOT_SEEN, Answer, late
from scenes.link.clients import Clients
from scenes.link.frame import HEADER, BadMessageError, framed, stamp_of
from scenes.link.messages import points, read_points, string, transform
from scenes.link.outgoing import Outgoing
from scenes.tracked.follower import Known, State
from scenes.tracked.registration_file import read_registration
from scenes.tracked.tool_motion import Motion
from sim.loads import Loads, Touching
from surrogate.model.learned import predicted

NOW = stamp_of(time.time())


@asynccontextmanager
async def served(receive=lambda number, header, content: None, most=16, longest=1 << 16):
    clients = Clients(receive, lambda kind: longest if kind == "TRANSFORM" else 0, most)
    server = await asyncio.start_server(clients.converse, HOST, 0)
    try:
        yield clients, server.sockets[0].getsockname()[1]
    finally:
        server.close()


async def until(what):
    async with asyncio.timeout(5.0):
        while not what():
            await asyncio.sleep(0.005)


def test_every_client_hears_the_newest_and_a_new_one_what_it_missed():
    async def scene():
        async with served() as (clients, port):
            clients.publish("a", [framed("STRING", "A", string("one"), NOW)])
            async with peers(port, 3) as three:
                for each in three:
                    header, body = await each.next()
                    assert (header.name, body[4:], header.stamp) == ("A", b"one", NOW)
                three[0].writer.transport.abort()
                await until(lambda: len(clients) == 2)
                clients.publish("a", [framed("STRING", "A", string("two"), NOW + 1)])
                assert [(await each.next())[1][4:] for each in three[1:]] == [b"two", b"two"]

    played(scene())


def test_a_client_that_does_not_read_gets_the_newest_later_and_keeps_nobody_waiting():
    count, large = 200, bytes(200_000)

    async def scene():
        async with served() as (clients, port):
            slow = socket.socket()
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
            slow.connect((HOST, port))
            async with peers(port, 1) as (quick,):
                await until(lambda: len(clients) == 2)
                await asyncio.sleep(1.2 * limits.GREETING)
                for number in range(count):
                    clients.publish("a", [framed("STRING", f"{number}", large, NOW)])
                    assert (await quick.next())[0].name == f"{number}"
            slow.setblocking(False)
            late = Peer(*await asyncio.open_connection(sock=slow))
            names = [(await late.next())[0].name]
            while names[-1] != f"{count - 1}":
                names.append((await late.next())[0].name)
            late.writer.transport.abort()
        assert len(names) < 20  # what it did not read in time was never queued

    played(scene())


@pytest.mark.parametrize(
    ("sent", "why", "goes_on"),
    [
        (b"\x16\x03\x01" + bytes(80), "no OpenIGTLink message", False),
        (framed("TRANSFORM", "A", bytes(48), 0)[:-1] + b"\1", "TRANSFORM A is refused: wrong checksum", True),
        (framed("TRANSFORM", "bad", bytes(48), 0), "TRANSFORM bad is refused: what", True),
        (framed("NDARRAY", "A", bytes(90), 0), "NDARRAY A is passed over: type not used", True),
        (framed("TRANSFORM", "A", bytes(1 << 17), 0), "too long", True),
        (HEADER.pack(1, b"POINT", b"A", 0, 1 << 60, 0), "announces 1152921504606846976 bytes", False),
    ],
)
def test_what_is_no_good_message_is_said_to_its_sender_alone(sent, why, goes_on):
    heard = []

    def receive(number, header, content):
        if header.name == "bad":
            raise BadMessageError("what: 7")
        heard.append(header.name)

    async def scene():
        async with served(receive) as (clients, port), peers(port, 2) as (bad, good):
            bad.writer.write(sent)
            assert why in await bad.said()
            assert clients.refused.total() == 1
            bad.send("TRANSFORM", "next", bytes(48))
            good.send("TRANSFORM", "fine", bytes(48))
            if not goes_on:
                with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
                    await bad.next()
            await until(lambda: len(heard) == 1 + goes_on)
            assert sorted(heard) == sorted(["fine", *["next"] * goes_on])
            await asyncio.sleep(1.2 * limits.GREETING)
            clients.publish("a", [framed("STRING", "A", b"", 0)])
            assert (await good.next())[0].kind == "STRING"  # and no STATUS before it

    played(scene())


def test_a_storm_of_clients_is_bounded_and_passes():
    async def scene():
        async with served(most=4) as (clients, port), peers(port, 1) as (first,):
            await until(lambda: len(clients) == 1)
            for _ in range(100):
                _, writer = await asyncio.open_connection(HOST, port)
                writer.write(b"\0\1TRANS")  # and vanish in the middle of a message
                assert len(clients) <= 4
                writer.close()
            async with peers(port, 8) as many:
                await until(lambda: len(clients) == 4)
                refused = [each for each in many if await busy(each)]
                assert len(refused) >= 5
            await until(lambda: len(clients) == 1)
            clients.publish("a", [framed("STRING", "A", b"", 0)])
            assert (await first.next())[0].name == "A"

    async def busy(peer):
        with suppress(TimeoutError):
            async with asyncio.timeout(0.4):
                return "4 clients are connected" in await peer.said()
        return False

    played(scene())


def test_a_client_that_asks_is_sent_that_and_nothing_else():
    async def scene():
        async with served() as (clients, port), peers(port, 1) as (one,):
            surfaces = [framed("POLYDATA", name, bytes(40), stamp) for name, stamp in (("O", 1), ("P", 2), ("Q", 2))]
            clients.publish("a", [framed("STRING", "A", string("s"), 0), *surfaces])
            for _ in range(2):
                clients.publish("b", [framed("STRING", "B", string("s"), 0)])
                one.send("GET_POLYDATA", "", b"")
                assert (await one.next())[0].name == "P"
            one.send("GET_IMAGE", "", b"")
            assert "no IMAGE yet" in await one.said()
            one.send("STT_STRING", "", b"")
            assert [(await one.next())[0].name for _ in range(5)] == ["A", "O", "P", "Q", "B"]

    played(scene())


@pytest.fixture(scope="module")
def truth(stage):
    return truth_of(stage)


@pytest.fixture(scope="module")
def registration():
    return read_registration(FILM / "registration.json")


@pytest.fixture(scope="module")
def beside(follower, truth):
    """T_reference_cube (4, 4) [mm] of the film's poses, as a tracker would send it."""
    return in_mm(follower.registration.T_patient_scan @ truth.T_scan_tool @ np.linalg.inv(follower.tool.T_cube_tool))


def test_the_tumour_comes_where_it_is_with_the_time_of_its_pose(follower, registration, truth, beside):
    row, stamp = 10, NOW + 12345
    expected = 1e3 * (follower.motion.stage.tumour_at_rest.vertices + truth.displacement[row])

    async def scene():
        async with linked(follower, registration, stale=0.5) as port, peers(port, 3) as (tracker, slicer, other):
            header, body = await slicer.next("POLYDATA", "TumourInScan")
            rest = corners_of(body)
            assert rest == pytest.approx(1e3 * follower.motion.stage.tumour_at_rest.vertices, abs=1e-3)
            tracker.send("TRANSFORM", "ProbeToTracker", transform(beside[row]), NOW)
            while "no StylusTipToReference yet; other transforms heard: ProbeToTracker" not in await slicer.said(
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
            assert "no StylusTipToReference yet; refused: 1 a matrix" in words or "the identity" in words
            assert not len(corners_of((await tracker.next("POLYDATA", "TumourNow"))[1]))

    played(scene())


@pytest.mark.parametrize("sent", [True, False])
def test_a_registration_of_nobody_knows_whom_is_used_and_doubtful(follower, registration, beside, truth, sent):
    into = in_mm(np.linalg.inv(registration.T_patient_scan))
    expected = 1e3 * (follower.motion.stage.tumour_at_rest.vertices + truth.displacement[10])

    async def scene():
        own = None if sent else replace(registration, scanned=None)
        async with linked(follower, own) as port, peers(port, 1) as (tracker,):
            if sent:
                assert "no ReferenceToRas yet" in await tracker.said("Sulcus")
                tracker.send("TRANSFORM", NAMES.registration, transform(into), NOW)
            tracker.send("POINT", "P", points(["a"], 1e3 * follower.motion.stage.tumour_at_rest.vertices[:1]))
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


def test_a_tool_that_was_near_and_is_then_too_far_for_any_tracker_is_doubtful(follower, registration, beside):
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


def test_places_inside_the_tumour_move_with_its_volume(stage):
    anatomy, outgoing = stage.anatomy, Outgoing(stage)
    rest = anatomy.mesh.nodes
    inner = np.setdiff1d(anatomy.tumour_nodes, anatomy.tumour_surface)
    tets = anatomy.mesh.tets[np.isin(anatomy.mesh.tets, anatomy.tumour_nodes).all(axis=1)]
    at = rest[tets[np.isin(tets, inner).any(axis=1)][:3]].mean(axis=1)
    # A stretch is no rigid motion and is linear: the volume's interpolation is exact, a surface point's is not.
    stretched = stage.nodes, 0.3 * (rest[stage.nodes] - rest[stage.nodes].mean(axis=0))
    moved = Known(0.0, State.GOOD, "", NOT_SEEN, motion_of(rest, *stretched), band=1e-3)
    assert len(at) == 3
    body = outgoing.messages(Answer(NOW, moved), outgoing.placed(["a", "b", "c"], at))[-2]
    found = 1e-3 * read_points(body[HEADER.size :])[1]
    assert found == pytest.approx(at + 0.3 * (at - rest[stage.nodes].mean(axis=0)), abs=1e-6)
    # A place on the cortex is not sent for a model that knows the tumour alone.
    tumour = replace(moved, motion=motion_of(rest, anatomy.tumour_nodes, 0.0 * rest[anatomy.tumour_nodes]))
    both = outgoing.placed(["a", "c"], np.vstack([at[:1], rest[anatomy.open_surface[:1, 0]]]))
    assert read_points(outgoing.messages(Answer(NOW, tumour), both)[-2][HEADER.size :])[0] == ["a"]


@pytest.mark.parametrize("state", [State.GOOD, State.UNSURE])
def test_an_answer_with_a_bound_is_stale_when_it_is_old(stage, state):
    known = Known(0.0, state, "words", NOT_SEEN, Motion(stage.anatomy.mesh.nodes), band=1e-3)
    assert late(Answer(NOW, known), 0.2, 0.3).known is known
    old = late(Answer(NOW, known, Gauge(np.zeros(3), np.ones(3))), 0.4, 0.3)
    assert old.known.state is State.STALE and old.known.band is old.gauge is None and "0.4 s old" in old.known.words


def motion_of(rest, nodes, displacement):
    positions = rest.copy()
    positions[nodes] += displacement
    nothing = Loads((Touching(np.eye(4)[None, None]),))
    answer = predicted(displacement[None], nodes, nothing, [False], 0.0, np.full((2, 1), np.nan), "")
    return Motion(positions, True, answer=answer)


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


def test_places_on_the_tumour_move_with_it_and_a_million_points_are_passed_over(follower, registration, truth, beside):
    rest = 1e3 * follower.motion.stage.tumour_at_rest.vertices

    async def scene():
        async with linked(follower, registration) as port, peers(port, 1) as (tracker,):
            tracker.send("POINT", "P", bytes(136 * 10**6))
            assert "too long" in await tracker.said()
            tracker.send("POINT", "P", points(["a"], rest[:1] + 100.0))
            assert "nor on open cortex" in (said := await tracker.said()) and ": a 1" in said
            mixed = np.vstack([rest[:1], rest[:2] + 100.0, rest[1:2]])
            tracker.send("POINT", "P", points(["a", "", "far", "b"], mixed))
            assert "number 2 1" in (said := await tracker.said()) and "far 1" in said and "others are followed" in said
            tracker.send("TRANSFORM", NAMES.tool, transform(beside[10]), NOW)
            while not len(body := (await tracker.next("POINT", "PointsNow"))[1]):
                pass
            names, found = read_points(body)
            assert names == ["a", "b"] and found == pytest.approx(rest[:2] + 1e3 * truth.displacement[10, :2], abs=1e-2)

    played(scene())
