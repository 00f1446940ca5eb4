"""The finite elements behind a page: a thread that answers the newest loads, to hold a live prediction against."""

from __future__ import annotations

import threading
import time as clock
from dataclasses import dataclass

from sim.deformation import Deformation
from sim.loads import Loads

from .play import start_of
from .scene import Scene
from .theatre import Theatre


@dataclass(frozen=True, eq=False)
class Truth:
    """The finite elements' answer to one frame: its number, the deformation, the loads, and seconds."""

    number: int
    loads: Loads
    deformation: Deformation
    seconds: float


class Referee:
    """A thread that answers the newest loads by finite elements; older ones that it did not reach are dropped.

    Where the finite elements fail, `failure` says why, and no further loads are answered.
    """

    def __init__(self, theatre: Theatre, scene: Scene) -> None:
        self.newest: tuple[int, Loads] | None = None
        self.truth: Truth | None = None
        self.failure: Exception | None = None
        self.closed = threading.Event()
        self.wake = threading.Condition()
        self.thread = threading.Thread(target=self._serve, args=(theatre, scene), name="fem", daemon=True)
        self.thread.start()

    def ask(self, number: int, loads: Loads) -> None:
        """Replace the question that waits."""
        with self.wake:
            self.newest = number, loads
            self.wake.notify()

    def close(self) -> None:
        """Stop after the solve in hand."""
        with self.wake:
            self.closed.set()
            self.wake.notify()
        self.thread.join()

    def _serve(self, theatre: Theatre, scene: Scene) -> None:
        try:
            self._judge(theatre, scene)
        except Exception as error:  # the page says it; the thread's own report goes to the terminal
            self.failure = error
            raise

    def _judge(self, theatre: Theatre, scene: Scene) -> None:
        deformer, last = theatre.deformer("fem", scene), None
        while True:
            with self.wake:
                self.wake.wait_for(lambda: self.closed.is_set() or self.newest is not None)
                if self.closed.is_set() or self.newest is None:
                    return
                (number, loads), self.newest = self.newest, None
            begun = clock.perf_counter()
            last = deformer.deform(loads, start=start_of(scene, last, loads.times[0]))
            self.truth = Truth(number, loads, last, clock.perf_counter() - begun)
