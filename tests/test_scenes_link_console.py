"""What a live link says on its console, and how often it sends the same STATUS."""

import asyncio
import socket
import time

import numpy as np
import pytest
from films import FILM, follower_of
from links import HOST, NAMES, linked, peers, played
from theatres import template_theatre

from scenes.link.console import limited, printed
from scenes.link.messages import transform
from scenes.script.registration_file import read_registration
from scenes.script.scene import find_scene


@pytest.fixture(scope="module")
def follower():
    return follower_of(template_theatre().stage(find_scene("palpate")))


def test_changes_are_noted_once_and_a_status_is_not_repeated_ten_times_a_second(follower):
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
                    one.send("TRANSFORM", NAMES.tool, transform(np.eye(4)))
                await noted("refused: TRANSFORM StylusTipToReference", "the identity")
                while "20 the identity" not in await one.said("Sulcus"):
                    pass
                assert await repeated(one, 1.5) <= 2
            await noted("goes; clients: 0")
            server = await asyncio.start_server(lambda reader, writer: writer.close(), HOST, other)
            await noted(f"{HOST}:{other} is heard")
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


def test_a_console_gets_no_storm_and_nothing_that_a_terminal_obeys(capsys):
    now, lines = [0.0], []
    note = limited(lines.append, lambda: now[0])
    for number in range(100):
        note(f"{number}")
    now[0] = 6.0
    note("last")
    assert lines == [*map(str, range(10)), "last (90 lines left out)"]
    printed("a\x1b[2Jb")
    assert capsys.readouterr().err == "sulcus link: a?[2Jb\n"
