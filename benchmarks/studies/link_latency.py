"""Latency of a live link: from a pose's time stamp until each client has received the resulting surface."""

import asyncio
import socket
import threading
import time
from dataclasses import dataclass

import numpy as np

from scenes.link.frame import HEADER, BadMessageError, pack_message, read_header, to_stamp, to_time
from scenes.link.messages import EncodedMesh, Status, encode_polydata, encode_status, encode_transform
from scenes.link.outgoing import SentPoints
from scenes.link.pose_responder import NO_TARGETS, CameraView, PoseResult
from scenes.link.received_transforms import ReceivedTransforms, TransformNames
from scenes.link.session import LinkSession
from scenes.tracked.follower import TrackingResult, TumourState
from scenes.tracked.tool_motion import BrainMotion
from sim.runtime.processes import process_pool, run_on_each

HOST = "127.0.0.1"
NAME = TransformNames().tool
CLIENTS = 3
# Number of warm-up poses, not timed.
WARM_UP = 15
# Maximum waiting time for a message [s].
PATIENCE = 20.0


@dataclass(frozen=True)
class Latency:
    """Latency of one run over all clients [ms]: median, 99th percentile, maximum; share of poses with a result [%]."""

    median: float
    p99: float
    most: float
    answered: float


class ShiftResponder:
    """Responder that shifts a surface by the pose: all work of a link without the time of a deformation model."""

    def __init__(self, point_count: int) -> None:
        """Build a strip of triangles between random points."""
        self._points = 0.05 * np.random.default_rng(0).normal(size=(point_count, 3))
        corners = np.arange(2 * point_count)[:, None] + np.arange(3)
        self._mesh = EncodedMesh.from_triangles(corners % point_count)

    def compute_result(
        self, transforms: ReceivedTransforms, time: float, wall_time: float, previous: TrackingResult | None = None
    ) -> PoseResult:
        """Return the pose's shift, as the motion of a brain with a valid result."""
        body = transforms.find_relative_transform(transforms.names.tool, time)
        if isinstance(body, str):
            return PoseResult(
                0, TrackingResult(wall_time, TumourState.NO_TOOL, body, NO_TARGETS, BrainMotion(self._points))
            )
        motion = BrainMotion(self._points + body.T[:3, 3], True)
        return PoseResult(body.stamp, TrackingResult(wall_time, TumourState.GOOD, "", NO_TARGETS, motion))

    def find_camera(self, transforms: ReceivedTransforms, time: float, stamp: int) -> CameraView | str:
        """Return the reason: there is no camera."""
        return "no camera"

    def build_scan(self, stamp: int) -> bytes:
        """Return the undeformed points."""
        return pack_message("POLYDATA", "TumourInScan", encode_polydata(1e3 * self._points, self._mesh), stamp)

    def build_messages(self, result: PoseResult, points: SentPoints | None = None) -> tuple[bytes, ...]:
        """Return the message with the surface."""
        body = encode_polydata(1e3 * result.tracking.motion.positions, self._mesh)
        return (pack_message("POLYDATA", "TumourNow", body, result.stamp),)

    def build_status(self, result: PoseResult, rejected: str) -> bytes:
        """Return the status of the result."""
        return pack_message("STATUS", "Sulcus", encode_status(Status.OK, result.tracking.warning), result.stamp)

    def attach_points(self, names: list[str], positions: np.ndarray) -> SentPoints:
        """Raise BadMessageError: no points are tracked."""
        raise BadMessageError("no places are followed")


def measure_latency(point_count: int, rate: float, duration: float) -> Latency:
    """Send poses at a rate [1/s] for a duration [s]; the server and three clients run in separate processes.

    Raises
    ------
    LostError
        A process that was killed.
    """
    count = WARM_UP + max(1, round(rate * duration))
    with process_pool(["cpu"], _serve, point_count) as server, process_pool(["cpu"] * CLIENTS, _nothing) as clients:
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
    """Return None, the state with which a client's process starts."""


def _serve(device: str, points: int) -> int:
    """Serve in a thread of this process; return the port."""
    found: list[int] = []
    ready = threading.Event()

    async def work() -> None:
        moved = ShiftResponder(points)
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
    """Send poses, each with its time; the last time stamp marks the end."""
    T = np.eye(4)
    with socket.create_connection((HOST, port)) as out:
        out.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=_drain, args=(out,), daemon=True).start()
        begun = time.perf_counter() + 1.0
        for number in range(count):
            time.sleep(max(0.0, begun + number / rate - time.perf_counter()))
            T[0, 3] = 1.0 + number
            out.sendall(pack_message("TRANSFORM", NAME, encode_transform(T), to_stamp(time.time())))
        time.sleep(0.5)
        out.sendall(pack_message("TRANSFORM", NAME, encode_transform(T), to_stamp(time.time() + 1e6)))
        time.sleep(0.5)


def _drain(source: socket.socket) -> None:
    try:
        while source.recv(1 << 16):
            pass
    except OSError:
        pass  # the connection was closed


def _received(nothing: None, task: tuple[int, int]) -> list[tuple[int, float]]:
    """Receive results: time stamps, and times of complete arrival [s since 1970], without warm-up poses."""
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
