"""Clients of bytes for a live link, over 127.0.0.1."""

import asyncio
import struct
import time
from contextlib import asynccontextmanager

import numpy as np

from scenes.link.frame import HEADER, pack_message, read_header, to_stamp
from scenes.link.outgoing import ResultEncoder
from scenes.link.pose_responder import PoseResponder
from scenes.link.received_transforms import ReceivedTransforms, TransformNames
from scenes.link.session import LinkSession

HOST = "127.0.0.1"
NAMES = TransformNames()
NOW = to_stamp(time.time())


def played(scene):
    """Run a scene; one that waits for what does not come fails."""
    asyncio.run(asyncio.wait_for(scene, 20.0))


class Peer:
    """A client of bytes."""

    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer

    async def next(self, kind="", name=""):
        """The next message (header, body) of a type and name."""
        while True:
            async with asyncio.timeout(5.0):
                header = read_header(await self.reader.readexactly(HEADER.size))
                body = await self.reader.readexactly(header.size)
            if kind in ("", header.kind) and name in ("", header.name):
                return header, body

    async def said(self, name="SulcusRefused"):
        return (await self.next("STATUS", name))[1][30:-1].decode()

    def send(self, kind, name, body, stamp=0):
        self.writer.write(pack_message(kind, name, body, stamp))


@asynccontextmanager
async def peers(port, count=1):
    found = [Peer(*await asyncio.open_connection(HOST, port)) for _ in range(count)]
    try:
        yield found
    finally:
        for each in found:
            each.writer.transport.abort()


@asynccontextmanager
async def linked(
    follower, registration=None, eye=None, tracking=1e-4, names=NAMES, source=None, stale=2.0, note=lambda line: None
):
    answering = PoseResponder(follower.motion, follower.tool, tracking, registration)
    speaks = ResultEncoder(follower.motion.stage, registration is not None)
    session = LinkSession(answering, speaks, ReceivedTransforms(names, stale), eye, log=note)
    ready = asyncio.get_running_loop().create_future()
    serving = asyncio.create_task(session.serve(HOST, 0, np.inf, ready, source))
    try:
        yield await ready
    finally:
        session.end()
        await serving


def corners_of(body):
    return np.frombuffer(body, ">f4", 3 * struct.unpack(">I", body[:4])[0], 40).reshape(-1, 3)


def in_mm(T):
    """A pose (..., 4, 4) [m] as it is sent."""
    out = T.copy()
    out[..., :3, 3] *= 1e3
    return out
