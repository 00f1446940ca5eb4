"""FEM thread of a page: it solves the newest frame, to show it or to compare a model with it."""

import threading
import time as clock
from dataclasses import dataclass

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads
from sim.runtime.threads import enter_background

from ..play.deformers import PatientSetup, plan_of
from ..play.player import Player
from ..play.replay import ReplaySession
from ..script.scene import Scene
from ..script.tool_paths import Touch

Question = tuple[int, Touch | None]
"""A frame's number, and the hand's touch if it has the tool."""


@dataclass(frozen=True, eq=False)
class FemResult:
    """Solution of one frame: its number, the deformation, the loads, and seconds; the request.

    The frame may be one on the way to the requested one.
    """

    number: int
    loads: Loads
    deformation: Deformation
    seconds: float
    asked: Question | None = None


class FemWorker:
    """Thread that solves the newest frame by FEM; older requests that it did not reach are dropped.

    It pauses while an image is drawn.
    It is prepared at the first request. Frames on the way to the requested one are solved too. If FEM fails, `failure`
    is the reason, and no further frames are solved; if loads are rejected, only that frame is skipped, and `refused` is
    its request. After the setup, `player` has the solver, and `plan` lists its solvers as sentences.
    """

    def __init__(self, theatre: PatientSetup, scene: Scene, turn: threading.Lock) -> None:
        """Start the thread; it holds the lock `turn` while it builds the solver: only one is built at a time."""
        self.newest: Question | None = None
        self.truth: FemResult | None = None
        self.failure: Exception | None = None
        self.refused: Question | None = None
        self.player: Player | None = None
        self.plan: tuple[str, ...] = ()
        self.turn = turn
        self.closed = threading.Event()
        self.wake = threading.Condition()
        self.thread = threading.Thread(target=self._serve, args=(theatre, scene), name="fem", daemon=True)
        self.thread.start()

    def ask(self, number: int, touch: Touch | None) -> None:
        """Replace the pending request; `touch` is the manual one, if the user has the tool.

        Nothing is solved twice: the request may be the one in progress, or the last one that was solved.
        """
        truth, question = self.truth, (number, touch)
        with self.wake:
            if truth is not None and truth.asked == question and truth.number == number:
                self.newest = None
            elif self.newest != question:
                self.newest = question
                self.wake.notify_all()

    def drop(self) -> None:
        """Take the question back: nothing is solved after the step in hand."""
        with self.wake:
            self.newest = None

    def wait_newer(self, question: Question, seen: FemResult | None, seconds: float) -> FemResult | None:
        """Wait up to `seconds` for a solution of a question, or on the way to it, other than `seen`; None after it."""

        def found() -> FemResult | None:
            truth = self.truth
            return truth if truth is not None and truth.asked == question and truth is not seen else None

        with self.wake:
            return self.wake.wait_for(found, seconds)

    def stop_soon(self) -> None:
        """Ask for no more after the solve in hand, and do not wait for it."""
        with self.wake:
            self.closed.set()
            self.wake.notify_all()

    def close(self) -> None:
        """Stop after the solve in hand."""
        self.stop_soon()
        self.thread.join()

    def _serve(self, theatre: PatientSetup, scene: Scene) -> None:
        enter_background()
        try:
            self._solve_questions(theatre, scene)
        except Exception as error:  # the page says it; the thread's own report goes to the terminal
            self.failure = error
            if not isinstance(error, InputError):
                raise

    def _solve_questions(self, theatre: PatientSetup, scene: Scene) -> None:
        session = None
        while (question := self._wait_for_question()) is not None:
            if session is None:
                session = self._prepare_session(theatre, scene)
                continue
            begun, (asked, touch) = clock.perf_counter(), question
            try:
                number, answer = session.approach_frame(asked, touch)
                loads, took = session.player.build_loads(number, touch), clock.perf_counter() - begun
                self.truth = FemResult(number, loads, answer, took, question)
                self.failure = self.refused = None
            except InputError as error:
                number, self.failure, self.refused = asked, error, question
            with self.wake:
                if self.newest == question and number == asked:
                    self.newest = None
                self.wake.notify_all()

    def _wait_for_question(self) -> Question | None:
        """Return the newest question, once there is one; None at the end."""
        with self.wake:
            self.wake.wait_for(lambda: self.closed.is_set() or self.newest is not None)
            return None if self.closed.is_set() else self.newest

    def _prepare_session(self, theatre: PatientSetup, scene: Scene) -> ReplaySession | None:
        """Return the finite elements; None where they are not wanted any more when it is their turn."""
        with self.turn:
            if self.closed.is_set() or self.newest is None:
                return None
            session = ReplaySession(theatre.build_player("fem", scene))
        self.player, self.plan = session.player, plan_of(session.player.deformer)
        return session
