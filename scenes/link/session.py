"""Event loop of a live link. A thread solves the newest pose; a separate task reports poses that are too old."""

import asyncio
import re
import time as clock
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ar.optics.calibration import Calibration

from ..tracked.follower import TrackingResult, TumourState, compute_error_radius
from ..tracked.overlay_painter import Painter
from .clients import LinkClients
from .console import format_address
from .frame import BadMessageError, Header, pack_message, to_stamp
from .messages import (
    IMAGE,
    POINT,
    Status,
    encode_image,
    encode_status,
    read_image,
    read_points,
    read_position,
    read_transform,
)
from .outgoing import MAX_PLACES, UNTRACKED_POINTS, SentPoints
from .pose_responder import CameraView, PoseResult, add_error_bound, mark_late
from .received_transforms import ReceivedTransforms, check_tracker_status

CHECK_INTERVAL = 0.1  # Interval of checks for missing input [s].
STATUS_INTERVAL = 1.0  # Interval of unchanged STATUS messages [s].
RECONNECT_INTERVAL = 1.0  # Interval of attempts to connect to a server [s].
MAX_OTHERS = 6  # Maximum number of other received transforms that are named when the required one does not arrive.
# Types that are received without a reply: a STATUS in reply to a STATUS would loop forever.
UNANSWERED = ("STATUS", "STRING", "CAPABILITY")
MAX_SHORT_BYTES = 1 << 16  # Maximum size of a message without an image or points [bytes], and allowance for headers.
READ_AHEAD_BYTES = 1 << 18  # Read-ahead size of a client [bytes].

Picture = tuple[np.ndarray, int]
"""Image (H, W, 3) uint8 and its time stamp."""


class PoseResponderLike(Protocol):
    """Interface of a solver for poses."""

    def compute_result(
        self, transforms: ReceivedTransforms, time: float, wall_time: float, previous: TrackingResult | None = None
    ) -> PoseResult:
        """Compute the result, see `PoseResponder.compute_result`."""
        ...

    def find_camera(self, transforms: ReceivedTransforms, time: float, stamp: int) -> CameraView | str:
        """Return the scan's pose in the camera's frame, see `PoseResponder.find_camera`."""
        ...


class MessageWriter(Protocol):
    """Interface of an encoder of results."""

    def build_scan(self, stamp: int) -> bytes:
        """Build the message with the tumour in the scan, see `ResultEncoder.build_scan`."""
        ...

    def build_messages(self, result: PoseResult, points: SentPoints | None = None) -> tuple[bytes, ...]:
        """Build the messages of a result, see `ResultEncoder.build_messages`."""
        ...

    def build_status(self, result: PoseResult, rejected: str) -> bytes:
        """Build the STATUS message of a result, see `ResultEncoder.build_status`."""
        ...

    def attach_points(self, names: list[str], positions: np.ndarray) -> SentPoints:
        """Attach points to tissue, see `ResultEncoder.attach_points`."""
        ...


@dataclass(frozen=True, eq=False)
class OverlayCamera:
    """Overlay on camera images; `tracking` is the standard deviation [m] of the camera's position along each axis."""

    calibration: Calibration
    painter: Painter
    tracking: float

    def draw(self, image: np.ndarray, tracking: TrackingResult, view: CameraView | str) -> np.ndarray:
        """Return an image (H, W, 3) uint8 with the drawn result.

        If `view` is not a pose but the reason why it is unknown, only this reason is drawn.
        """
        if isinstance(view, str):
            tracking = replace(tracking, state=TumourState.NO_REFERENCE, warning=f"{view}: nothing is drawn")
            return self.painter.paint(image, tracking).colour
        T = view.T_camera_scan
        if tracking.bound is not None:
            middle = tracking.motion.positions[self.painter.stage.tumour_vertices].mean(axis=0)
            placed = compute_error_radius(self.tracking**2 * np.eye(3), T[:3, :3] @ middle + T[:3, 3])
            parts = {**tracking.sources, "camera": placed, "time": view.motion_error}
            bound = float(np.linalg.norm([tracking.bound, placed, view.motion_error]))
            tracking = add_error_bound(tracking, bound, parts)
        return self.painter.paint(image, replace(tracking, camera=self.calibration.build_camera(T))).colour


class LinkSession:
    """Live link that receives poses, computes results, and publishes the results.

    All methods except `_compute_messages` and drawing run in the event loop's thread.

    Parameters
    ----------
    responder, encoder
        Solver for poses, and encoder of its results.
    transforms
        Initial transforms, with the names of the transforms to receive.
    camera
        Overlay on received images; None: images are not accepted.
    max_clients
        Maximum number of clients.
    log
        Callback for a line of text when clients, the source or the tumour's state change, or a message is rejected.
    """

    def __init__(
        self,
        responder: PoseResponderLike,
        encoder: MessageWriter,
        transforms: ReceivedTransforms,
        camera: OverlayCamera | None = None,
        max_clients: int = 16,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.clients = LinkClients(self._receive, self._get_max_size, max_clients, log)
        self._note = log
        self._answers, self._speaks, self._heard, self._eye = responder, encoder, transforms, camera
        self._others: dict[str, None] = {}
        self._places: SentPoints | None = None
        self._states: set[TumourState] = set()
        self._loop = asyncio.get_running_loop()
        self._solved = self._shown = responder.compute_result(transforms, self._loop.time(), clock.time())
        # Arrival of the pose that was solved last, and start of the solution that is being computed [s].
        self._arrived = self._begun = np.inf
        self._posed, self._pictured = asyncio.Event(), asyncio.Event()
        self._picture: Picture | None = None
        self._ended = asyncio.Event()

    def end(self) -> None:
        """Notify all clients of the end, and end `serve`; this method may be called in any thread."""
        with suppress(RuntimeError):  # the loop is closed: it has ended
            self._loop.call_soon_threadsafe(self._ended.set)

    async def serve(
        self, host: str, port: int, seconds: float, ready: asyncio.Future[int], source: tuple[str, int] | None = None
    ) -> None:
        """Serve clients for `seconds` [s]; `ready` receives the port.

        Messages may also be received from a server `source` (host, port); a lost connection to this server is retried.

        Raises
        ------
        OSError
            No server can be opened at this address.
        """
        server = await asyncio.start_server(self.clients.serve_connection, host, port, limit=READ_AHEAD_BYTES)
        ready.set_result(server.sockets[0].getsockname()[1])
        work = [] if source is None else [asyncio.create_task(self._connected(*source))]
        try:
            await self._work(seconds)
        finally:
            server.close()
            for each in work:
                each.cancel()

    async def _connected(self, host: str, port: int) -> None:
        reached, at = True, f"the server {format_address(host, port)}"
        while True:
            try:
                streams = await asyncio.open_connection(host, port, limit=READ_AHEAD_BYTES)
            except OSError as error:
                if reached:
                    self._note(f"{at} cannot be reached ({error}): start it, or mend --client. It is tried again")
                reached = False
            else:
                reached = True
                self._note(f"{at} is connected")
                with suppress(OSError):
                    await self.clients.listen(*streams)
                self._note(f"{at} has ended the connection")
            await asyncio.sleep(RECONNECT_INTERVAL)

    async def _work(self, seconds: float) -> None:
        self.clients.publish("scan", (self._speaks.build_scan(0),))
        self._publish(self._solved, self._speaks.build_messages(self._solved))
        with ThreadPoolExecutor(1, "answer") as answering, ThreadPoolExecutor(1, "draw") as drawing:
            work = [self._keep_reporting(), self._keep_solving(answering)]
            work += [] if self._eye is None else [self._keep_drawing(self._eye, drawing)]
            tasks = [asyncio.create_task(each) for each in work]
            ended = asyncio.create_task(self._ended.wait())
            limit = seconds if np.isfinite(seconds) else None
            done, _ = await asyncio.wait((*tasks, ended), timeout=limit, return_when=asyncio.FIRST_COMPLETED)
            for task in (*tasks, ended):
                task.cancel()
            over = pack_message(
                "STATUS", "Sulcus", encode_status(Status.SHUTDOWN, "the server ends"), to_stamp(clock.time())
            )
            self.clients.publish("status", (over,))
            await self.clients.close()
            for task in done:
                task.result()  # raises the exception of the task

    async def _keep_solving(self, thread: ThreadPoolExecutor) -> None:
        """Compute and publish the result for the newest pose, repeatedly."""
        while True:
            await self._posed.wait()
            self._posed.clear()
            heard, places, self._begun = self._heard, self._places, self._loop.time()
            body = heard.find_relative_transform(heard.names.tool, self._begun)
            result, messages = await self._loop.run_in_executor(
                thread, self._compute_messages, heard, places, self._begun
            )
            self._solved, self._begun = result, np.inf
            self._arrived = np.inf if isinstance(body, str) else body.arrived
            current = self._get_current_result(self._loop.time())
            # A pose may have grown old while its solution was computed.
            self._publish(current, messages if current is result else self._speaks.build_messages(current, places))

    async def _keep_reporting(self) -> None:
        """Report repeatedly, independent of the solver, if a pose or its result is too old, and publish a STATUS."""
        said: object = None
        beat = 0.0
        while True:
            now, kinds = self._loop.time(), frozenset(self.clients.refused)
            if (result := self._get_current_result(now)) is not self._shown:
                self._publish(result, self._speaks.build_messages(result, self._places))
            known = result.tracking
            # A growing number alone is not reported again.
            saying = known.state, re.sub(r"[\d.]+", "", known.warning), kinds, tuple(self._others)
            if saying != said or now - beat >= STATUS_INTERVAL:
                said, beat = saying, now
                self.clients.publish("status", (self._speaks.build_status(result, self._format_rejected(known)),))
            await asyncio.sleep(CHECK_INTERVAL)

    def _get_current_result(self, time: float) -> PoseResult:
        """Return the last result; if it is not valid at a time [s], return a result with the reason."""
        if isinstance(self._heard.find_relative_transform(self._heard.names.tool, time), str):
            return self._answers.compute_result(self._heard, time, clock.time(), self._shown.tracking)
        result, waited = mark_late(self._solved, time - self._arrived, self._heard.max_age), time - self._begun
        if (
            result is self._solved
            and result.tracking.state in (TumourState.NO_TOOL, TumourState.STALE)
            and waited > STATUS_INTERVAL
        ):
            late = replace(result.tracking, warning=f"no solution yet, computing for {waited:.0f} s")
            return replace(result, tracking=late)
        return result

    def _compute_messages(
        self, transforms: ReceivedTransforms, points: SentPoints | None, time: float
    ) -> tuple[PoseResult, tuple[bytes, ...]]:
        """Compute a result and its messages; called in the solver's thread."""
        result = self._answers.compute_result(transforms, time, clock.time(), self._shown.tracking)
        return result, self._speaks.build_messages(result, points)

    def _publish(self, result: PoseResult, messages: tuple[bytes, ...]) -> None:
        self._shown = result
        if result.tracking.state not in self._states:
            self._states.add(result.tracking.state)
            self._note(f"the tumour is {_describe_state(result.tracking)}")
        self.clients.publish("answer", messages)

    def _format_rejected(self, tracking: TrackingResult) -> str:
        """Describe rejected messages, and, if the tool's transform is missing, list other received transforms."""
        parts = [f"{number} {why}" for why, number in self.clients.refused.most_common(MAX_OTHERS)]
        words = f"; rejected: {', '.join(parts)}" if parts else ""
        if self._others and tracking.state in (TumourState.NO_TOOL, TumourState.STALE):
            words += f"; other transforms received: {', '.join(self._others)}"
        return words

    async def _keep_drawing(self, overlay_camera: OverlayCamera, thread: ThreadPoolExecutor) -> None:
        """Draw the overlay on the newest image and publish the image, repeatedly."""
        while True:
            await self._pictured.wait()
            self._pictured.clear()
            if self._picture is None:
                continue
            (colour, stamp), heard = self._picture, self._heard
            camera = self._answers.find_camera(heard, self._loop.time(), stamp)
            drawn = await self._loop.run_in_executor(thread, overlay_camera.draw, colour, self._shown.tracking, camera)
            self.clients.publish("picture", (pack_message("IMAGE", "Overlay", encode_image(drawn), stamp),))

    def _get_max_size(self, message_type: str) -> int:
        """Return the maximum size [bytes] of a message of a type; 0 if the type is not used."""
        if message_type == "IMAGE" and self._eye is not None:
            return IMAGE.size + 4 * self._eye.calibration.width * self._eye.calibration.height + MAX_SHORT_BYTES
        if message_type == "POINT":
            return MAX_PLACES * POINT.size + MAX_SHORT_BYTES
        return MAX_SHORT_BYTES if message_type in ("TRANSFORM", "POSITION", *UNANSWERED) else 0

    def _receive(self, number: int, header: Header, content: bytes) -> None:
        """Process the content of a message from a client; raise `BadMessageError` if the content is invalid."""
        match header.kind:
            case "TRANSFORM" | "POSITION":
                self._receive_transform(number, header, content)
            case "IMAGE" if self._eye is not None:
                colour, wanted = read_image(content), self._eye.calibration
                if colour.shape[:2] != (wanted.height, wanted.width):
                    size = f"{colour.shape[1]} x {colour.shape[0]}"
                    raise BadMessageError(
                        f"another size than the camera's: {size}, not {wanted.width} x {wanted.height}"
                    )
                self._picture = colour, header.stamp
                self._pictured.set()
            case "POINT":
                names, places = read_points(content)
                self._places = self._speaks.attach_points(names, 1e-3 * places)
                self._posed.set()
                if self._places.unattached:
                    words = f"{UNTRACKED_POINTS}: {self._places.unattached}; the others are followed"
                    self.clients.reject(number, Status.CONFIGURATION, UNTRACKED_POINTS, words)

    def _receive_transform(self, number: int, header: Header, content: bytes) -> None:
        names = self._heard.names
        name = names.by_wire.get(header.name)
        if name is None:
            if header.name and len(self._others) < MAX_OTHERS:
                self._others[header.name] = None
            return
        check_tracker_status(header.metadata)
        matrix = (read_transform if header.kind == "TRANSFORM" else read_position)(content)
        self._heard = self._heard.add_transform(name, matrix, header.stamp, self._loop.time(), number)
        if name in (names.tool, names.registration):
            self._posed.set()


def _describe_state(tracking: TrackingResult) -> str:
    """Describe the state of the tumour for the console."""
    if tracking.is_reliable:
        return f"known, {tracking.state.value}"
    return f"{'doubtful' if tracking.state is TumourState.UNSURE else 'not known'}: {tracking.warning}"
