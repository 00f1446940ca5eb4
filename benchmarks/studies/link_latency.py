"""How long a live link takes: from a pose's time stamp to when each client has the whole surface that answers it."""

import asyncio
import socket
import threading
import time
from dataclasses import dataclass

import numpy as np

from scenes.link.frame import HEADER, BadMessageError, pack_message, read_header, to_stamp, to_time
from scenes.link.messages import Code, SentMesh, encode_polydata, encode_status, transform
from scenes.link.outgoing import SentPlaces
from scenes.link.pose_responder import NO_TARGETS, CameraView, PoseResult
from scenes.link.received_transforms import ReceivedTransforms, TransformNames
from scenes.link.session import LinkSession
from scenes.tracked.follower import TrackingResult, TumourState
from scenes.tracked.tool_motion import BrainMotion
from sim.runtime.processes import process_pool, run_on_each

HOST = "127.0.0.1"
NAME = TransformNames().tool
CLIENTS = 3
# Poses before the first that counts.
WARM_UP = 15
# So long a message may be awaited [s].
PATIENCE = 20.0


@dataclass(frozen=True)
class Latency:
    """Of one run [ms], over all clients: median, 99th percentile and largest; and the share of poses answered [%]."""

    median: float
    p99: float
    most: float
    answered: float


class Moved:
    """Answers a pose by a surface of so many points that is shifted by it: all but the deformer's own time is there."""

    def __init__(self, points: int) -> None:
        """A strip of triangles between points at random."""
        self._points = 0.05 * np.random.default_rng(0).normal(size=(points, 3))
        corners = np.arange(2 * points)[:, None] + np.arange(3)
        self._mesh = SentMesh.from_triangles(corners % points)

    def compute_result(
        self, heard: ReceivedTransforms, now: float, moment: float, before: TrackingResult | None = None
    ) -> PoseResult:
        """The pose's shift, as the motion of a brain that is known."""
        body = heard.find_relative(heard.names.tool, now)
        if isinstance(body, str):
            return PoseResult(
                0, TrackingResult(moment, TumourState.NO_TOOL, body, NO_TARGETS, BrainMotion(self._points))
            )
        motion = BrainMotion(self._points + body.T[:3, 3], True)
        return PoseResult(body.stamp, TrackingResult(moment, TumourState.GOOD, "", NO_TARGETS, motion))

    def find_camera(self, heard: ReceivedTransforms, now: float, stamp: int) -> CameraView | str:
        """No camera is listened to."""
        return "no camera"

    def build_scan(self, stamp: int) -> bytes:
        """The points where they were."""
        return pack_message("POLYDATA", "TumourInScan", encode_polydata(1e3 * self._points, self._mesh), stamp)

    def build_messages(self, result: PoseResult, places: SentPlaces | None = None) -> tuple[bytes, ...]:
        """The surface."""
        body = encode_polydata(1e3 * result.known.motion.positions, self._mesh)
        return (pack_message("POLYDATA", "TumourNow", body, result.stamp),)

    def build_status(self, result: PoseResult, refused: str) -> bytes:
        """What is known."""
        return pack_message("STATUS", "Sulcus", encode_status(Code.OK, result.known.words), result.stamp)

    def attach_points(self, names: list[str], at: np.ndarray) -> SentPlaces:
        """No places are followed."""
        raise BadMessageError("no places are followed")


def measured(points: int, rate: float, seconds: float) -> Latency:
    """Send poses at a rate [1/s] for so long, to a server and three clients in processes of their own.

    Raises
    ------
    LostError
        A process that was ended.
    """
    count = WARM_UP + max(1, round(rate * seconds))
    with process_pool(["cpu"], _serve, points) as server, process_pool(["cpu"] * CLIENTS, _nothing) as clients:
        port = run_on_each(server, _port, [0])[0]
        sender = threading.Thread(target=_send, args=(port, rate, count), daemon=True)
        sender.start()
        found = run_on_each(clients, _received, [(port, count)] * CLIENTS)
    late = [[after - to_time(stamp) for stamp, after in each] for each in found]
    milliseconds = 1e3 * np.concatenate([np.array(each) for each in late])
    answered = 100.0 * len(milliseconds) / (CLIENTS * (count - WARM_UP))
    p99 = float(np.percentile(milliseconds, 99.0))
    return Latency(float(np.median(milliseconds)), p99, float(milliseconds.max()), answered)


def _nothing(device: str) -> None:
    """What a client's process starts with."""


def _serve(device: str, points: int) -> int:
    """Serve in a thread of this process; returns the port."""
    found: list[int] = []
    ready = threading.Event()

    async def work() -> None:
        moved = Moved(points)
        session = LinkSession(moved, moved, ReceivedTransforms(TransformNames(), PATIENCE))
        port = asyncio.get_running_loop().create_future()
        port.add_done_callback(lambda port: (found.append(port.result()), ready.set()))
        await session.serve(HOST, 0, np.inf, port)

    threading.Thread(target=lambda: asyncio.run(work()), daemon=True).start()
    ready.wait(PATIENCE)
    return found[0]


def _port(port: int, task: int) -> int:
    return port


def _send(port: int, rate: float, count: int) -> None:
    """Send poses, each with its time; the last time stamp says that it is over."""
    T = np.eye(4)
    with socket.create_connection((HOST, port)) as out:
        out.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=_drain, args=(out,), daemon=True).start()
        begun = time.perf_counter() + 1.0
        for number in range(count):
            time.sleep(max(0.0, begun + number / rate - time.perf_counter()))
            T[0, 3] = 1.0 + number
            out.sendall(pack_message("TRANSFORM", NAME, transform(T), to_stamp(time.time())))
        time.sleep(0.5)
        out.sendall(pack_message("TRANSFORM", NAME, transform(T), to_stamp(time.time() + 1e6)))
        time.sleep(0.5)


def _drain(source: socket.socket) -> None:
    try:
        while source.recv(1 << 16):
            pass
    except OSError:
        pass  # it was closed


def _received(nothing: None, task: tuple[int, int]) -> list[tuple[int, float]]:
    """Time stamps of answers, and when each was here whole [s since 1970]; the first ones are left out."""
    port, _ = task
    stamps: list[tuple[int, float]] = []
    with socket.create_connection((HOST, port), PATIENCE) as source:
        while True:
            header = read_header(_exactly(source, HEADER.size))
            _exactly(source, header.size)
            here = time.time()
            if header.name != "TumourNow" or not header.stamp:
                continue
            if to_time(header.stamp) > here + 1e5:
                return stamps[WARM_UP:]
            stamps.append((header.stamp, here))


def _exactly(source: socket.socket, size: int) -> bytes:
    raw = bytearray(size)
    view = memoryview(raw)
    while view:
        got = source.recv_into(view)
        if not got:
            raise ConnectionError("the server ended")
        view = view[got:]
    return bytes(raw)
