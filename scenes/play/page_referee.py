"""The finite elements behind a page: a thread that answers the newest frame, to hold a live prediction against."""

from __future__ import annotations

import threading
import time as clock
from dataclasses import dataclass

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads

from ..script.scene import Scene
from ..script.tool_paths import Touch
from .deformers import Theatre, plan_of
from .replay import Session


@dataclass(frozen=True, eq=False)
class Truth:
    """The finite elements' answer to one frame: its number, the deformation, the loads, and seconds."""

    number: int
    loads: Loads
    deformation: Deformation
    seconds: float


class Referee:
    """A thread that answers the newest frame by finite elements; older ones that it did not reach are dropped.

    Frames on the way to it that what went before is known from are answered too. Where the finite elements fail,
    `failure` says why, and no further frames are answered; where they refuse loads, that frame is left out alone.
    `plan` says in sentences which solvers they try, as soon as they are set up.
    """

    def __init__(self, theatre: Theatre, scene: Scene) -> None:
        self.newest: tuple[int, Touch | None] | None = None
        self.truth: Truth | None = None
        self.failure: Exception | None = None
        self.plan: tuple[str, ...] = ()
        self.closed = threading.Event()
        self.wake = threading.Condition()
        self.thread = threading.Thread(target=self._serve, args=(theatre, scene), name="fem", daemon=True)
        self.thread.start()

    def ask(self, number: int, touch: Touch | None) -> None:
        """Replace the question that waits; `touch` is the hand's, if it has the tool."""
        with self.wake:
            self.newest = number, touch
            self.wake.notify()

    def dismiss(self) -> None:
        """Ask for no more after the solve in hand, and do not wait for it."""
        with self.wake:
            self.closed.set()
            self.wake.notify()

    def close(self) -> None:
        """Stop after the solve in hand."""
        self.dismiss()
        self.thread.join()

    def _serve(self, theatre: Theatre, scene: Scene) -> None:
        try:
            self._judge(theatre, scene)
        except Exception as error:  # the page says it; the thread's own report goes to the terminal
            self.failure = error
            raise

    def _judge(self, theatre: Theatre, scene: Scene) -> None:
        session = Session(theatre.player("fem", scene))
        self.plan = plan_of(session.player.deformer)
        while True:
            with self.wake:
                self.wake.wait_for(lambda: self.closed.is_set() or self.newest is not None)
                if self.closed.is_set() or self.newest is None:
                    return
                question = self.newest
            begun, (asked, touch) = clock.perf_counter(), question
            try:
                number, answer = session.towards(asked, touch)
                self.truth = Truth(number, session.player.loads(number, touch), answer, clock.perf_counter() - begun)
                self.failure = None
            except InputError as error:
                number, self.failure = asked, error
            with self.wake:
                if self.newest is question and number == asked:
                    self.newest = None
