"""The finite elements of a page: a thread that answers the newest frame, to show it or to judge a model by it."""

from __future__ import annotations

import threading
import time as clock
from dataclasses import dataclass

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads

from ..play.deformers import Theatre, plan_of
from ..play.player import Player
from ..play.replay import Session
from ..script.scene import Scene
from ..script.tool_paths import Touch

Question = tuple[int, Touch | None]
"""A frame's number, and the hand's touch if it has the tool."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The answer to one frame: its number, the deformation, the loads, and seconds; the question that was asked.

    The frame may be one on the way to the question's.
    """

    number: int
    loads: Loads
    deformation: Deformation
    seconds: float
    asked: Question | None = None


class Referee:
    """A thread that answers the newest frame by finite elements; older ones that it did not reach are dropped.

    It prepares when it is first asked. Frames on the way to the one that is asked for are answered too. Where the
    finite elements fail, `failure` says why, and no further frames are answered; where they refuse loads, that frame is
    left out alone, and `refused` says which. `player` has them, and `plan` says in sentences which solvers they try, as
    soon as they are set up.
    """

    def __init__(self, theatre: Theatre, scene: Scene, turn: threading.Lock) -> None:
        """Start the thread; it holds `turn` while it prepares, so that of several one does at a time."""
        self.newest: Question | None = None
        self.truth: Truth | None = None
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
        """Replace the question that waits; `touch` is the hand's, if it has the tool.

        Nothing is solved twice: the question may be the one in hand, or the last one that was answered.
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

    def newer(self, question: Question, seen: Truth | None, seconds: float) -> Truth | None:
        """An answer to a question, or on the way to it, that was not seen yet; wait for it so long at most."""

        def found() -> Truth | None:
            truth = self.truth
            return truth if truth is not None and truth.asked == question and truth is not seen else None

        with self.wake:
            return self.wake.wait_for(found, seconds)

    def dismiss(self) -> None:
        """Ask for no more after the solve in hand, and do not wait for it."""
        with self.wake:
            self.closed.set()
            self.wake.notify_all()

    def close(self) -> None:
        """Stop after the solve in hand."""
        self.dismiss()
        self.thread.join()

    def _serve(self, theatre: Theatre, scene: Scene) -> None:
        try:
            self._judge(theatre, scene)
        except Exception as error:  # the page says it; the thread's own report goes to the terminal
            self.failure = error
            if not isinstance(error, InputError):
                raise

    def _judge(self, theatre: Theatre, scene: Scene) -> None:
        session = None
        while (question := self._next()) is not None:
            if session is None:
                session = self._prepared(theatre, scene)
                continue
            begun, (asked, touch) = clock.perf_counter(), question
            try:
                number, answer = session.towards(asked, touch)
                loads, took = session.player.loads(number, touch), clock.perf_counter() - begun
                self.truth = Truth(number, loads, answer, took, question)
                self.failure = self.refused = None
            except InputError as error:
                number, self.failure, self.refused = asked, error, question
            with self.wake:
                if self.newest == question and number == asked:
                    self.newest = None
                self.wake.notify_all()

    def _next(self) -> Question | None:
        """The newest question, once there is one; None at the end."""
        with self.wake:
            self.wake.wait_for(lambda: self.closed.is_set() or self.newest is not None)
            return None if self.closed.is_set() else self.newest

    def _prepared(self, theatre: Theatre, scene: Scene) -> Session | None:
        """The finite elements; None where they are not wanted any more when it is their turn."""
        with self.turn:
            if self.closed.is_set() or self.newest is None:
                return None
            session = Session(theatre.player("fem", scene))
        self.player, self.plan = session.player, plan_of(session.player.deformer)
        return session
