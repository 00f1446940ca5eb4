"""FEM solutions of the page: newest request and displayed frame."""

import threading
import time

import numpy as np
from visitor import run_until, wait_for

from scenes.page.fem_worker import FemWorker


def test_paused_page_shows_fem_solution_that_arrives_later(demo, monkeypatch):
    """The frame is drawn before its FEM solution exists, and no further frame updates the tumour."""
    asked = []
    monkeypatch.setattr(demo.referee, "ask", lambda number, touch, rest: asked.append((number, touch)))
    demo.wish.set(plays=False, number=90)
    fem = demo.browser.meshes["finite elements"]
    rest = np.array(fem.vertices)

    seen = []

    def moved():
        seen.append(demo.referee.truth)
        if len(seen) == 5:
            FemWorker.ask(demo.referee, *asked[0])
        return np.linalg.norm(fem.vertices - rest, axis=1).max() > 5e-4

    run_until(demo, monkeypatch, moved)
    assert len(asked) == 1 and seen[:5] == [None] * 5


def test_fem_worker_solves_the_newest_request(theatre, scene):
    referee = FemWorker(theatre, scene, threading.Lock())
    for number in range(60):
        referee.ask(number, None)
    assert wait_for(lambda: referee.truth is not None and referee.truth.number == 59)
    truth = referee.truth
    assert truth is not None and truth.deformation.time[0] == truth.loads.times[0] == scene.times[59]
    assert truth.deformation.outcome[0].good and truth.seconds > 0.0
    referee.close()
    assert not referee.thread.is_alive()


def test_fem_worker_rests_between_comparisons(theatre, scene):
    """The worker waits in proportion to the last solve, unless a request asks for no rest; closing ends the wait."""
    referee = FemWorker(theatre, scene, threading.Lock())
    referee.ask(20, None)
    assert wait_for(lambda: referee.truth is not None)
    begun, duration = time.perf_counter(), referee.solve_time
    referee.ask(21, None, rest=1.0 + 1.0 / duration)
    assert wait_for(lambda: referee.truth.number == 21)
    assert time.perf_counter() - begun > 0.9
    referee.ask(22, None, rest=1e6)
    time.sleep(0.5)
    assert referee.truth.number == 21
    referee.ask(23, None)
    assert wait_for(lambda: referee.truth.number == 23)
    referee.ask(24, None, rest=1e6)
    referee.close()
    assert referee.truth.number == 23 and not referee.thread.is_alive()
