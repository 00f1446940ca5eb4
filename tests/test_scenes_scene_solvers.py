"""Page with slow finite elements: intermediate frames, jumps, pauses and failures."""

import threading
import time
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from conftest import make_box
from visitor import Visitor, free_port, wait_for

from scenes.page.demo import Demo
from scenes.page.fem_worker import FemWorker
from scenes.play.deformers import PatientSetup, RestDeformer
from scenes.play.player import Player
from scenes.script.scene import Viewpoint, find_scene
from scenes.script.tool_paths import lay
from sim.deformation import Outcome
from sim.errors import InputError

FRAMES = 16
"""As many as are kept."""


@dataclass
class Gated:
    """Finite elements that pass a gate before each answer, and count what they were asked for, by frame."""

    still: RestDeformer
    gate: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    solved: Counter = field(default_factory=Counter)

    @property
    def anatomy(self):
        return self.still.anatomy

    def let(self, answers):
        self.gate.release(answers)

    def deform(self, loads, start=None, at=None):
        self.solved[round(30 * loads.times[0])] += 1
        self.gate.acquire()
        found = self.still.deform(loads, start, at)
        return replace(found, outcome=(Outcome.CONVERGED,), time=loads.times)


@pytest.fixture
def gated(monkeypatch):
    """The only finite elements, whoever asks for some."""
    made = Gated(RestDeformer(make_box(cells=(6, 6, 4), spacing=12e-3)))
    monkeypatch.setattr(
        PatientSetup, "build_player", lambda theatre, name, scene: Player(theatre.build_stage(scene), made)
    )
    yield made
    made.let(10_000)


def ordered():
    """A scene each of whose frames depends on the one before."""
    scene = replace(find_scene("retract"), viewpoint=Viewpoint(width=64, height=48))
    return replace(scene, path=lay(depth=2e-3, rise=0.2), duration=(FRAMES - 1) / 30)


def opened(theatre, scene, deformer="fem"):
    return Demo(theatre, scene, deformer, "127.0.0.1", free_port())


@pytest.fixture
def demo(gated):
    demo = opened(PatientSetup(gated.anatomy, None, {}, "cpu"), ordered())
    demo.wish.set(plays=False)
    yield demo
    gated.let(10_000)
    demo.close()


class Stopped(BaseException):
    """A test is over."""


class Loop:
    """The page's loop on a thread of its own; what it raises fails the test."""

    def __init__(self, demo):
        self.demo, self.failed = demo, []
        self.thread = threading.Thread(target=self.play)
        self.plays = demo.browser.show_playback

    def play(self):
        try:
            self.demo.run()
        except Stopped:
            pass
        except Exception as error:
            self.failed.append(error)

    def stop(self, playing):
        """Ends the loop, which says all the time whether the scene plays."""
        raise Stopped

    def __enter__(self):
        self.thread.start()
        return self.demo.browser

    def __exit__(self, *_):
        self.demo.browser.show_playback = self.stop
        self.demo.wish.set(plays=True)  # a page that is paused shows an error until it is asked for more
        self.thread.join()
        self.demo.browser.show_playback = self.plays
        assert not self.failed


def shows(page, number, of=FRAMES):
    return f"frame {number} of {of - 1}" in page.shown[2]


def ask_for_frame_12(demo, gated, page, steps):
    """So many frames on the way are answered, and the next is in hand."""
    demo.wish.set(number=12)
    gated.let(steps)
    assert wait_for(lambda: shows(page, steps - 1) and gated.solved[steps])


def test_intermediate_frames_are_shown_and_slider_stays(demo, gated, monkeypatch):
    said, begun = [], demo.busy.begin_work
    monkeypatch.setattr(demo.busy, "begin_work", lambda what: said.append(what) or begun(what))
    with Loop(demo) as page:
        gated.let(1)
        assert wait_for(lambda: shows(page, 0))
        visitor = Visitor(page, 1200)
        visitor.set(page.frame, 12)
        for number in (1, 2, 3):
            gated.let(1)
            assert wait_for(lambda number=number: shows(page, number))
            pending = f"Result pending: frame {number} of 15 is shown, on the way to frame 12."
            assert wait_for(lambda pending=pending: pending in page.shown[2])
            assert wait_for(lambda number=number: said[-1] == f"on the way to frame 12: frame {number} is solved")
        assert page.frame.value == 12 and page.shown[3] == 12
        gated.let(9)
        assert wait_for(lambda: shows(page, 12)) and "converged" in page.shown[2]
        assert "Result pending" not in page.shown[2]
        visitor.wire.close()


def test_jump_to_solved_frame_stops_the_pending_solve(demo, gated):
    with Loop(demo) as page:
        ask_for_frame_12(demo, gated, page, 4)
        demo.wish.set(number=1)
        assert wait_for(lambda: demo.fem_worker.newest == (1, None))
        gated.let(1)  # the step in hand
        assert wait_for(lambda: shows(page, 1))
        gated.let(100)
        time.sleep(0.3)
        assert set(gated.solved) == set(range(5))
        demo.wish.set(number=6)
        assert wait_for(lambda: shows(page, 6))
        assert gated.solved == Counter(range(7))


def test_pause_stops_the_pending_solve(demo, gated):
    with Loop(demo) as page:
        visitor = Visitor(page, 1200)
        assert wait_for(lambda: page.button.label == "Play")
        visitor.set(page.button, True)
        assert wait_for(lambda: demo.wish.plays)
        visitor.set(page.frame, 12)
        assert wait_for(lambda: demo.wish.number == 12)
        gated.let(3)
        assert wait_for(lambda: shows(page, 2) and gated.solved[3])
        visitor.set(page.button, True)
        assert wait_for(lambda: not demo.wish.plays and demo.fem_worker.newest is None)
        gated.let(100)
        time.sleep(0.3)
        assert shows(page, 2) and set(gated.solved) == set(range(4)) and page.frame.value == 2
        visitor.wire.close()


def test_effect_switch_starts_new_solver_and_stops_old_one(demo, gated):
    with Loop(demo) as page:
        ask_for_frame_12(demo, gated, page, 3)
        full = demo.fem_worker
        demo.wish.switch_effect("Retraction", False)
        assert wait_for(lambda: len(demo.cast.solvers) == 2 and full.newest is None)
        gated.let(1 + 13)  # the step in hand, and all frames without the effect
        assert wait_for(lambda: shows(page, 12) and "Switched off: the spatula" in page.shown[2])
        assert full.truth.number == 3 and wait_for(lambda: gated.solved[4] == 2)  # then they are compared


def test_frame_jumps_reuse_solutions_and_end_at_last_target(demo, gated):
    gated.let(10_000)
    before = set(threading.enumerate())
    with Loop(demo) as page:
        visitor = Visitor(page, 1200)
        for number in np.random.default_rng(0).integers(0, FRAMES, 300).tolist():
            visitor.set(page.frame, number)
        visitor.set(page.frame, 11)
        assert wait_for(lambda: demo.wish.number == 11 and shows(page, 11))
        assert max(gated.solved.values()) == 1
        assert len([thread for thread in set(threading.enumerate()) - before if thread.name == "fem"]) == 1
        visitor.wire.close()


def test_overlay_style_changes_during_a_solve(demo, gated):
    with Loop(demo) as page:
        gated.let(1)
        assert wait_for(lambda: shows(page, 0))
        demo.wish.set(number=5)
        assert wait_for(lambda: gated.solved[1])
        picture = page.shown[1]
        demo.wish.set(style="contour")
        assert wait_for(lambda: (page.shown[1] != picture).any())
        assert shows(page, 0) and gated.solved == Counter((0, 1))


def test_undeformed_body_is_shown_while_fem_is_prepared(gated, monkeypatch):
    prepared, said = threading.Event(), []
    player = PatientSetup.build_player

    def slow(theatre, name, scene):
        assert prepared.wait(30.0)
        return player(theatre, name, scene)

    monkeypatch.setattr(PatientSetup, "build_player", slow)
    gated.let(1)
    demo = opened(PatientSetup(gated.anatomy, None, {}, "cpu"), ordered())
    monkeypatch.setattr(demo.busy, "begin_work", said.append)
    demo.wish.set(plays=False)
    with Loop(demo) as page:
        assert wait_for(lambda: "undeformed body, as in the scan" in page.shown[2])
        assert len(np.unique(page.shown[1])) > 20 and set(said) == {"preparing the finite elements"}
        prepared.set()
        assert wait_for(lambda: shows(page, 0) and "at rest" not in page.shown[2])
    demo.close()


def test_skipped_scenes_are_not_prepared(demo, monkeypatch):
    """A visitor selects several scenes while the first is prepared."""
    prepared, made = threading.Event(), []
    player = PatientSetup.build_player

    def slow(theatre, name, scene):
        made.append(scene.name)
        assert prepared.wait(30.0)
        return player(theatre, name, scene)

    monkeypatch.setattr(PatientSetup, "build_player", slow)
    with Loop(demo):
        assert wait_for(lambda: made == ["retract"])
        for name in ("slide", "draw", "palpate", "press"):
            demo.wish.set(scene=name)
            assert wait_for(lambda name=name: demo.stage.scene.name == name and demo.cast.solvers)
        prepared.set()
        assert wait_for(lambda: len(made) == 2)
        assert wait_for(lambda: all(not solver.thread.is_alive() for solver in demo.dismissed))
    assert made == ["retract", "press"]


def test_dropped_request_prepares_no_solver(gated, monkeypatch):
    made = []
    player = PatientSetup.build_player
    monkeypatch.setattr(PatientSetup, "build_player", lambda *words: made.append(words) or player(*words))
    theatre, turn = PatientSetup(gated.anatomy, None, {}, "cpu"), threading.Lock()
    gated.let(2)
    with turn:
        referee = FemWorker(theatre, ordered(), turn)
        referee.request_frame(0, None)
        time.sleep(0.1)
        referee.drop_request()
    time.sleep(0.1)
    assert made == []
    referee.request_frame(0, None)
    assert wait_for(lambda: referee.truth is not None) and len(made) == 1
    referee.close()


class TestFailures:
    @pytest.fixture
    def theatre(self, gated):
        gated.let(10_000)
        return PatientSetup(gated.anatomy, None, {}, "cpu")

    def test_first_scene_rejected_by_fem_ends_the_run(self, theatre, monkeypatch):
        def refusing(theatre, name, scene):
            raise InputError("the body is not held.")

        monkeypatch.setattr(PatientSetup, "build_player", refusing)
        demo = opened(theatre, ordered())
        with pytest.raises(InputError, match="the body is not held"):
            demo.run(30.0)
        demo.close()

    @pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
    def test_defect_is_reported_and_later_frames_are_solved(self, theatre, gated, monkeypatch):
        deform = Gated.deform

        def failing(fem, loads, start=None, at=None):
            if round(30 * loads.times[0]) == 2 and not fem.solved[2]:
                fem.solved[2] += 1
                raise IndexError("none such")
            return deform(fem, loads, start, at)

        monkeypatch.setattr(Gated, "deform", failing)
        demo = opened(theatre, ordered())
        demo.wish.set(plays=False, number=5)
        with Loop(demo) as page:
            assert wait_for(lambda: "a defect: IndexError, none such" in page.shown[2])
            demo.wish.set(number=4)
            assert wait_for(lambda: shows(page, 4))
        demo.close()
