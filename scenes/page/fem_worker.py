"""FEM thread of a page, which solves the newest requested frame for display or for comparison with a model."""

import threading
import time as clock
from dataclasses import dataclass

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads
from sim.runtime.threads import count_cores, enter_background

from ..play.deformers import PatientSetup, describe_solvers
from ..play.player import Player
from ..play.replay import ReplaySession
from ..script.scene import Scene
from ..script.tool_paths import Touch

FrameRequest = tuple[int, Touch | None]
"""Frame number, and manual tool input (None: the tool follows the script)."""
# Pause between comparisons with FEM while playing, relative to the duration of one: leaves few CPU cores to the images.
COMPARISON_REST = 2.0 if count_cores() < 4 else 0.0


@dataclass(frozen=True, eq=False)
class FemResult:
    """FEM or model solution of one frame: frame number, loads, deformation, duration [s], and the request.

    The frame may be an intermediate frame before the requested frame.
    """

    number: int
    loads: Loads
    deformation: Deformation
    seconds: float
    request: FrameRequest | None = None


class FemWorker:
    """Thread that solves the newest requested frame by FEM; older pending requests are dropped.

    The thread pauses while an image is drawn, and after a solve for the `rest` of the request. The first request builds
    the solver. Intermediate frames before the requested frame are solved too. `truth` is the newest solution. If loads
    are rejected, `failure` is the reason and `refused` the request, and the thread continues; after any other exception
    the thread ends. When the solver is built, `player` contains it, and `plan` describes its solvers in sentences.
    """

    def __init__(self, patient: PatientSetup, scene: Scene, build_lock: threading.Lock) -> None:
        """Start the thread, which keeps `build_lock` while it builds the solver: solvers are built one at a time."""
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
        """Replace the pending request; `touch` is the manual tool input, or None if the tool follows the script.

        A request that is in progress or was solved last is not solved again. `rest` is the pause before the next solve,
        relative to the duration of the last solve.
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
        """Withdraw the pending request; the thread stops solving after the current step."""
        with self.wake:
            self.newest = None

    def wait_for_result(self, request: FrameRequest, previous: FemResult | None, seconds: float) -> FemResult | None:
        """Wait up to `seconds` for a solution of `request` other than `previous`; return None after that time."""

        def find_newer_result() -> FemResult | None:
            result = self.truth
            return result if result is not None and result.request == request and result is not previous else None

        with self.wake:
            return self.wake.wait_for(find_newer_result, seconds)

    def stop_soon(self) -> None:
        """Tell the thread to end after the current solve; return without waiting."""
        with self.wake:
            self.closed.set()
            self.wake.notify_all()

    def close(self) -> None:
        """Stop the thread after the current solve, and wait for its end."""
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
        """Wait for a request and the end of the pause; return the newest request, or None if the worker is closed."""
        with self.wake:
            while not self.closed.is_set():
                left = self.solved_at + self.rest * self.solve_time - clock.perf_counter()
                if self.newest is not None and left <= 0.0:
                    return self.newest
                self.wake.wait(None if self.newest is None else left)
            return None

    def _prepare_session(self, patient: PatientSetup, scene: Scene) -> ReplaySession | None:
        """Build the FEM session; return None if the request was withdrawn while the thread waited for the lock."""
        with self.build_lock:
            if self.closed.is_set() or self.newest is None:
                return None
            session = ReplaySession(patient.build_player("fem", scene))
        self.player, self.plan = session.player, describe_solvers(session.player.deformer)
        return session
