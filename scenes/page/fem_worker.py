"""FEM thread of a page: it solves the newest frame, to show it or to compare a model with it."""

import os
import threading
import time as clock
from dataclasses import dataclass

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads
from sim.runtime.threads import enter_background

from ..play.deformers import PatientSetup, describe_solvers
from ..play.player import Player
from ..play.replay import ReplaySession
from ..script.scene import Scene
from ..script.tool_paths import Touch

FrameRequest = tuple[int, Touch | None]
"""Number of a frame, and the touch under manual control, else None."""
# Pause between comparisons with FEM while playing, relative to the duration of one: leaves few CPU cores to the images.
COMPARISON_REST = 2.0 if (os.cpu_count() or 1) < 4 else 0.0


@dataclass(frozen=True, eq=False)
class FemResult:
    """Solution of one frame: frame number, loads, deformation, duration [s], and the request.

    The frame may be one on the way to the requested one.
    """

    number: int
    loads: Loads
    deformation: Deformation
    seconds: float
    request: FrameRequest | None = None


class FemWorker:
    """Thread that solves the newest frame by FEM; older pending requests are dropped.

    The thread pauses while an image is drawn, and after a solve if a request asks for that.
    It is prepared at the first request. Frames on the way to the requested one are solved too. If FEM fails, `failure`
    is the reason, and no further frames are solved; if loads are rejected, only that frame is skipped, and `refused` is
    its request. After the setup, `player` has the solver, and `plan` lists its solvers as sentences.
    """

    def __init__(self, patient: PatientSetup, scene: Scene, build_lock: threading.Lock) -> None:
        """Start the thread; it holds `build_lock` while it builds the solver: only one is built at a time."""
        self.newest: FrameRequest | None = None
        self.truth: FemResult | None = None
        self.failure: Exception | None = None
        self.refused: FrameRequest | None = None
        self.player: Player | None = None
        self.plan: tuple[str, ...] = ()
        self.build_lock = build_lock
        self.solved_at = self.solve_time = self.rest = 0.0
        self.closed = threading.Event()
        self.wake = threading.Condition()
        self.thread = threading.Thread(target=self._serve, args=(patient, scene), name="fem", daemon=True)
        self.thread.start()

    def request_frame(self, number: int, touch: Touch | None, rest: float = 0.0) -> None:
        """Replace the pending request; `touch` is the manual one, if the user has the tool.

        Nothing is solved twice: the request may be the one in progress, or the last one that was solved. `rest` is the
        pause before the next solve, relative to the duration of the last.
        """
        result, request = self.truth, (number, touch)
        with self.wake:
            self.rest = rest
            if result is not None and result.request == request and result.number == number:
                self.newest = None
            elif self.newest != request:
                self.newest = request
                self.wake.notify_all()

    def drop_request(self) -> None:
        """Withdraw the request: nothing is solved after the current step."""
        with self.wake:
            self.newest = None

    def wait_for_newer(self, request: FrameRequest, previous: FemResult | None, seconds: float) -> FemResult | None:
        """Wait up to `seconds` for another solution than `previous` for a request; None after that time."""

        def find_newer() -> FemResult | None:
            result = self.truth
            return result if result is not None and result.request == request and result is not previous else None

        with self.wake:
            return self.wake.wait_for(find_newer, seconds)

    def stop_soon(self) -> None:
        """Request the end of the thread after the current solve, without waiting."""
        with self.wake:
            self.closed.set()
            self.wake.notify_all()

    def close(self) -> None:
        """Stop after the current solve, and wait for the thread's end."""
        self.stop_soon()
        self.thread.join()

    def _serve(self, patient: PatientSetup, scene: Scene) -> None:
        enter_background()
        try:
            self._solve_requests(patient, scene)
        except Exception as error:  # shown on the page; a traceback goes to the terminal
            self.failure = error
            if not isinstance(error, InputError):
                raise

    def _solve_requests(self, patient: PatientSetup, scene: Scene) -> None:
        session = None
        while (request := self._wait_for_request()) is not None:
            if session is None:
                session = self._prepare_session(patient, scene)
                continue
            start, (requested, touch) = clock.perf_counter(), request
            try:
                number, deformation = session.approach_frame(requested, touch)
                loads, seconds = session.player.build_loads(number, touch), clock.perf_counter() - start
                self.truth = FemResult(number, loads, deformation, seconds, request)
                self.failure = self.refused = None
            except InputError as error:
                number, self.failure, self.refused = requested, error, request
            with self.wake:
                self.solved_at = clock.perf_counter()
                self.solve_time = self.solved_at - start
                if self.newest == request and number == requested:
                    self.newest = None
                self.wake.notify_all()

    def _wait_for_request(self) -> FrameRequest | None:
        """Return the newest request, once there is one and the pause is over; None at the end."""
        with self.wake:
            while not self.closed.is_set():
                left = self.solved_at + self.rest * self.solve_time - clock.perf_counter()
                if self.newest is not None and left <= 0.0:
                    return self.newest
                self.wake.wait(None if self.newest is None else left)
            return None

    def _prepare_session(self, patient: PatientSetup, scene: Scene) -> ReplaySession | None:
        """Build the FEM session; None if the request was withdrawn while this thread waited for the lock."""
        with self.build_lock:
            if self.closed.is_set() or self.newest is None:
                return None
            session = ReplaySession(patient.build_player("fem", scene))
        self.player, self.plan = session.player, describe_solvers(session.player.deformer)
        return session
