"""Console output of a live link, and its rate limits."""

import asyncio
import re
import socket
import threading
import time
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from films import FILM, follower_of, solve_reference_frames
from links import HOST, NAMES, corners_of, in_mm, linked, peers, played
from theatres import template_theatre

from scenes.link.console import limit_rate, print_safely
from scenes.link.frame import to_stamp
from scenes.link.messages import encode_transform
from scenes.script.scene import find_scene
from scenes.tracked.registration_file import read_registration

BEGUN = to_stamp(time.time())


@pytest.fixture(scope="module")
def follower():
    return follower_of(template_theatre().build_stage(find_scene("palpate")))


def test_status_changes_are_logged_once(follower):
    lines = []
    with socket.socket() as free:
        free.bind((HOST, 0))
        other = free.getsockname()[1]

    async def noted(*words):
        async with asyncio.timeout(5.0):
            while not any(all(each in line for each in words) for line in lines):
                await asyncio.sleep(0.01)

    async def scene():
        registration = read_registration(FILM / "registration.json")
        async with linked(follower, registration, source=(HOST, other), note=lines.append) as port:
            await noted(f"{HOST}:{other} cannot be reached")
            async with peers(port) as (one,):
                await noted("comes; clients: 1")
                for _ in range(20):
                    one.send("TRANSFORM", NAMES.tool, encode_transform(np.eye(4)))
                await noted("rejected: TRANSFORM StylusTipToReference", "the identity")
                while "20 the identity" not in await one.said("Sulcus"):
                    pass
                assert await repeated(one, 1.5) <= 2
            await noted("goes; clients: 0")
            server = await asyncio.start_server(lambda reader, writer: writer.close(), HOST, other)
            await noted(f"{HOST}:{other} is connected")
            await noted("has ended the connection")
            server.close()

    async def repeated(peer, seconds):
        """How many STATUS come in so long."""
        count, end = 0, time.monotonic() + seconds
        while time.monotonic() < end:
            await peer.said("Sulcus")
            count += 1
        return count - 1  # the last one came after the end

    played(scene())
    for each in ("cannot be reached", "the identity", "no StylusTipToReference yet", "comes"):
        assert sum(each in line for line in lines) == 1, (each, lines)


def test_link_reports_slow_solver_and_drops_old_results(follower):
    """Results older than `stale` are not sent, and each STATUS is on time, while one solution takes 2 s."""
    registration = read_registration(FILM / "registration.json")
    poses = registration.T_patient_scan @ solve_reference_frames(follower.motion.stage).T_scan_tool
    beside = in_mm(poses[10] @ np.linalg.inv(follower.tool.T_cube_tool))
    slow, stale, sent = threading.Event(), 0.3, {}

    class Slow:
        def deform(self, loads, start=None, at=None):
            time.sleep(1.0 if slow.is_set() else 0.0)  # a pose takes two
            return follower.motion.deformer.deform(loads)

    async def track(tracker):
        for number in count():
            sent[BEGUN + number] = time.monotonic()
            tracker.send("TRANSFORM", NAMES.tool, encode_transform(beside), BEGUN + number)
            await asyncio.sleep(0.03)

    async def scene():
        motion = replace(follower.motion, deformer=Slow())
        link = linked(replace(follower, motion=motion), registration, stale=stale)
        async with link as port, peers(port, 2) as (tracker, viewer):
            slow.set()
            moving = asyncio.create_task(track(tracker))
            while "no solution yet, computing for 1 s" not in await viewer.said("Sulcus"):
                pass
            slow.clear()
            await viewer.next("TRANSFORM", "TumourToRas")
            slow.set()
            begun = heard = time.monotonic()
            words, ages = set(), [0.0]
            while (now := time.monotonic()) < begun + 4.0:
                header, body = await viewer.next()
                if header.name == "TumourNow":
                    ages.append(now - sent[header.stamp] if len(corners_of(body)) else 0.0)
                    emptied.append(now - begun) if not len(corners_of(body)) else None
                if header.name == "Sulcus":
                    words.add(re.sub(r"[\d.]+", "", body[30:-1].decode()))
                    assert now - heard < 1.3
                    heard = now
            assert max(ages) < stale + 0.1 and emptied[0] < stale + 0.3
            assert any("stale, the result is" in each for each in words)
            slow.clear()
            while not len(corners_of((await viewer.next("POLYDATA", "TumourNow"))[1])):
                pass
            moving.cancel()

    emptied = []
    played(scene())


def test_console_limits_rate_and_strips_control_codes(capsys):
    now, lines = [0.0], []
    note = limit_rate(lines.append, lambda: now[0])
    for number in range(100):
        note(f"{number}")
    now[0] = 6.0
    note("last")
    assert lines == [*map(str, range(10)), "last (90 lines left out)"]
    print_safely("a\x1b[2Jb")
    assert capsys.readouterr().err == "sulcus link: a?[2Jb\n"
