"""Requests of visitors: playback, frame selection, manual control, and rejected loads."""

import threading
import time
from dataclasses import replace

import pytest
from theatres import Silent
from visitor import Visitor, report, wait_for

from scenes.page.demo import MESSAGE_TIME
from scenes.page.fem_worker import FemWorker
from scenes.page.requests import HAND, SCRIPT, Requests, describe_tool_control
from scenes.play.deformers import PatientSetup
from scenes.play.player import Player
from scenes.script.tool_paths import Touch
from sim.errors import InputError


class TestWish:
    def test_play_repeats_from_the_first_frame(self):
        wish = Requests("linear", Touch(force=0.1))
        assert [self.played(wish) for _ in range(5)] == [0, 1, 2, 0, 1]
        wish.set(plays=False)
        assert [self.played(wish) for _ in range(3)] == [2, 2, 2]

    @staticmethod
    def played(wish):
        """The frame that is shown next, of three."""
        number = wish.read_current()[0]
        wish.step_playback(number, 3)
        return number

    def test_requested_frame_is_not_overridden_by_playback(self):
        wish = Requests("linear", Touch())
        wish.set(number=2)
        wish.step_playback(0, 3)
        assert wish.read_current()[0] == 2

    def test_manual_control_keeps_unchanged_values(self):
        wish = Requests("linear", Touch(force=0.1))
        assert wish.read_current()[2] is None
        wish.set_manual_input(x=0.01)
        assert wish.read_current()[2] == Touch(x=0.01, force=0.1)
        wish.set_manual_input(force=0.3)
        assert wish.read_current()[2] == Touch(x=0.01, force=0.3)
        wish.set(tool=SCRIPT, deformer="fem")
        assert wish.read_current()[1:3] == ("fem", None)

    def test_simultaneous_slider_changes_are_both_applied(self):
        """The page calls each slider in its own thread."""
        wish = Requests("linear", Touch(force=0.1))
        hands = [threading.Thread(target=wish.set_manual_input, args=turn) for turn in ((0.2,), (None, -0.3))]
        with wish.lock:  # both are under way before either is heard
            for hand in hands:
                hand.start()
            time.sleep(0.05)
        for hand in hands:
            hand.join()
        assert wish.read_current()[2] == Touch(force=0.1, tilt=(0.2, -0.3))


@pytest.fixture
def silent(monkeypatch):
    monkeypatch.setattr("scenes.page.scene_solvers.FemWorker", Silent)


@pytest.fixture
def demo(silent, demo):
    demo.wish.set(plays=False)
    return demo


@pytest.fixture
def running(demo):
    """The loop on a thread of its own, for a test's time; what it raises fails the test."""
    done = threading.Event()
    failed = []

    def play():
        while not done.is_set():
            try:
                demo.run(0.3)
            except Exception as error:
                failed.append(error)
                return

    loop = threading.Thread(target=play)
    loop.start()
    yield demo
    done.set()
    loop.join()
    assert not failed


def refuse(monkeypatch, refused, error):
    """Have loads refused that `refused` says, by frame number and touch."""
    loads = Player.build_loads

    def refusing(player, number, touch=None):
        if refused(number, touch):
            raise error
        return loads(player, number, touch)

    monkeypatch.setattr(Player, "build_loads", refusing)


def test_rejected_load_is_shown_on_the_page(running, monkeypatch):
    refuse(monkeypatch, lambda number, touch: touch and touch.force > 0.3, InputError("0.35 N is too much: push less."))
    one, other = Visitor(running.browser, 1200), Visitor(running.browser, 1200)
    assert wait_for(lambda: running.browser.visitors == 2)
    one.set(running.browser.inputs["force [N]"], 0.35)
    assert wait_for(lambda: "error: this frame is left out (0.35 N is too much: push less.)" in report(running))
    one.wire.close()
    assert wait_for(lambda: running.browser.visitors == 1)
    other.set(running.browser.inputs["force [N]"], 0.21)
    assert wait_for(lambda: "force 0.21 N" in report(running))
    other.wire.close()


def test_exception_is_logged_in_one_line_and_play_continues(demo, monkeypatch, capfd):
    refuse(monkeypatch, lambda number, touch: number == 5, IndexError("none such"))
    demo.wish.set(plays=True, number=4)
    assert demo.run(MESSAGE_TIME + 1.5) > 1
    assert demo.wish.number > 5
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "sulcus demo: a defect: IndexError, none such (line" in said


def test_loads_rejected_by_fem_are_skipped(theatre, scene, monkeypatch):
    refuse(monkeypatch, lambda number, touch: number == 7, InputError("7 is refused."))
    player = theatre.build_player("linear", scene)  # as quick to have, and asked the same way
    monkeypatch.setattr(PatientSetup, "build_player", lambda *words: player)
    referee = FemWorker(theatre, scene, threading.Lock())
    referee.request_frame(7, None)
    assert wait_for(lambda: str(referee.failure) == "7 is refused.")
    referee.request_frame(8, None)
    assert wait_for(lambda: referee.truth is not None and referee.truth.number == 8)
    assert referee.failure is None and referee.thread.is_alive()
    referee.close()


def test_each_visitor_sees_who_controls_the_tool(running):
    page = running.browser
    one = Visitor(page, 1200)
    assert wait_for(lambda: page.visitors == 1)
    other = Visitor(page, 1200)
    assert wait_for(lambda: page.here == {1, 2})

    def read():
        return [row.line.content for _, row in sorted(page.crowd.rows.items())]

    assert wait_for(lambda: len(read()) == 2 and all("Automatic playback; 2 visitors" in line for line in read()))
    one.set(page.inputs["force [N]"], 0.31)
    assert wait_for(lambda: "**You control the tool**" in read()[0] and "Visitor 1 controls" in read()[1])
    other.set(page.crowd.rows[1].request_button, True)
    assert wait_for(lambda: page.crowd.rows[0].release_button.visible)
    one.set(page.crowd.rows[0].release_button, True)
    assert wait_for(lambda: "You have control" in read()[1])
    other.set(page.inputs["place up [mm]"], 3.0)
    assert wait_for(lambda: "Visitor 2 controls" in read()[0] and "**You control" in read()[1])
    other.wire.close()
    assert wait_for(lambda: read() == [describe_tool_control(1, 2, {1})])
    assert "Visitor 2, who controlled the tool, has left" in read()[0]
    one.set(page.inputs["tool"], SCRIPT)
    assert wait_for(lambda: read() == ["Automatic playback"])
    one.wire.close()


def test_manual_control_starts_at_the_scripted_tool_position(demo, monkeypatch):
    """With a slider and with the menu; the sliders follow the script."""
    demo.wish.set(plays=False, number=100)
    path = demo.stage.scene.path

    def moved(time):
        return replace(path(time), x=3e-3, y=-2e-3, force=0.25, tilt=(0.1, -0.05))

    monkeypatch.setitem(vars(demo.stage.scene), "path", moved)
    visitor, inputs = Visitor(demo.browser, 1200), demo.browser.inputs
    labels = ("force [N]", "place right [mm]", "place up [mm]", "direction right [deg]", "direction up [deg]")

    def shown():
        return [inputs[label].value for label in labels]

    assert wait_for(lambda: demo.run(0.2) and shown() == [0.25, 3.0, -2.0, 5.73, -2.86])
    visitor.set(inputs["tool"], HAND)
    assert wait_for(lambda: demo.wish.tool == HAND) and demo.wish.touch == moved(0.0)
    visitor.set(inputs["force [N]"], 0.1)
    assert wait_for(lambda: demo.wish.touch.force == 0.1)
    demo.run(0.2)
    assert shown()[0] == 0.1
    visitor.set(inputs["tool"], SCRIPT)
    assert wait_for(lambda: demo.run(0.2) and demo.wish.tool == SCRIPT and shown()[0] == 0.25)
    visitor.set(inputs["place up [mm]"], 1.0)
    assert wait_for(lambda: demo.wish.tool == HAND)
    assert demo.wish.touch == replace(moved(0.0), y=1e-3)
    visitor.wire.close()
