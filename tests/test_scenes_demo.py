"""The page alive, without a browser: it plays, listens, is refereed, and goes away."""

import threading
import time

import numpy as np
import pytest
from theatres import small, theatre_of
from visitor import Visitor, free_port, wait_for

from ar.browser import Browser
from scenes.demo import HAND, SCRIPT, Demo, Wish
from scenes.paths import Touch, press
from scenes.referee import Referee
from sim.fem import Fem
from surrogate.learned import Learned


@pytest.fixture(scope="module")
def theatre(box):
    return theatre_of(box)


@pytest.fixture
def scene():
    """Two seconds, of which the first half presses harder and harder; cheap frames, quickly."""
    return small(path=press(0.3, rise=1.0, hold=1.0), duration=2.0, frames_per_second=60.0)


@pytest.fixture
def demo(theatre, scene):
    before = set(threading.enumerate())
    demo = Demo(theatre, scene, "linear", "127.0.0.1", free_port())
    yield demo
    demo.close()
    assert wait_for(lambda: not [t for t in set(threading.enumerate()) - before if t.name in ("page", "fem")])


@pytest.fixture
def running(demo):
    """The loop on a thread of its own, as the test takes the visitor's part."""
    done, drawn = threading.Event(), []

    def play():
        while not done.is_set():
            drawn.append(demo.run(0.5))

    loop = threading.Thread(target=play)
    loop.start()
    visitor = Visitor(demo.browser, 1200)
    assert wait_for(lambda: demo.browser.visitors == 1)
    yield demo, visitor
    done.set()
    loop.join()
    visitor.wire.close()
    assert sum(drawn) > 5


def report(demo):
    return demo.browser.text.content


def test_it_plays_by_itself_and_is_refereed(demo, theatre):
    assert demo.run(2.0) > 1
    demo.wish.set(plays=False)
    # The error belongs to the frame that the finite elements answered, and says which.
    assert wait_for(lambda: demo.run(0.3) and f"(frame {demo.wish.number}, FEM" in report(demo))
    text = report(demo)
    assert "error against FEM: mean" in text
    assert (
        "**linear**: predicted by a learnt model" in text and "tip to tumour" in text and "ms a stage: deform" in text
    )
    truth = demo.referee.truth
    assert truth.number == demo.wish.number
    nodes = theatre.anatomy.tumour_nodes
    scene = demo.stage.scene
    loads = scene.loads(theatre.site, scene.path(scene.times[truth.number]), scene.times[truth.number])
    assert np.array_equal(loads.causes[0].force, truth.loads.causes[0].force)
    off = theatre.models["linear"].deform(loads, at=nodes).displacement[0] - truth.deformation.at(nodes).displacement[0]
    assert f"mean {1e3 * np.linalg.norm(off, axis=1).mean():.3f}" in text
    assert demo.browser.picture.image.shape == (240, 320, 3)
    assert len(np.unique(demo.browser.picture.image)) > 50


def test_while_it_is_paused_the_answer_that_comes_later_is_shown(demo, monkeypatch):
    """The frame was drawn before the finite elements answered it: no further one brings their tumour along."""
    asked = []
    monkeypatch.setattr(demo.referee, "ask", lambda number, touch: asked.append((number, touch)))
    demo.wish.set(plays=False, number=90)
    fem = demo.browser.meshes["finite elements"]
    rest = np.array(fem.vertices)

    def later():
        time.sleep(0.5)
        Referee.ask(demo.referee, *asked[0])

    answer = threading.Thread(target=later)
    answer.start()
    assert demo.run(3.0) == 1 and len(asked) == 1
    answer.join()
    assert wait_for(lambda: np.linalg.norm(fem.vertices - rest, axis=1).max() > 5e-4)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_finite_elements_that_fail_are_not_waited_for(demo, monkeypatch):
    def overflowing(fem, loads, start=None, at=None):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(Fem, "deform", overflowing)
    assert wait_for(lambda: demo.run(0.3) and "do not answer any more (out of memory)" in report(demo))


def test_the_error_is_found_once_for_each_answer(demo, monkeypatch):
    demo.wish.set(plays=False, number=30)
    answer, asked = Learned.deform, []

    def counted(model, loads, start=None, at=None):
        asked.append(loads)
        return answer(model, loads, start, at)

    monkeypatch.setattr(Learned, "deform", counted)
    demo.run(1.5)
    assert wait_for(lambda: "error against FEM: mean" in report(demo))
    assert len(asked) == 2  # for the picture, and for the error


def test_the_3d_view_follows(demo, theatre):
    demo.wish.set(plays=False, number=90)
    assert demo.run(1.0) >= 1
    tumour = np.asarray(demo.browser.meshes["tumour"].vertices)
    rest = demo.stage.tumour(theatre.anatomy.mesh.nodes).vertices
    assert wait_for(lambda: np.linalg.norm(demo.browser.meshes["tumour"].vertices - rest, axis=1).max() > 5e-4)
    meshes = demo.browser.meshes
    assert wait_for(
        lambda: (
            demo.run(0.3)
            and np.linalg.norm(meshes["finite elements"].vertices - meshes["tumour"].vertices, axis=1).max() < 2e-4
        )
    )
    assert tumour.shape == rest.shape


def test_visitors_take_over_scrub_and_switch(running):
    demo, visitor = running
    page = demo.browser
    visitor.set(page.inputs["force [N]"], 0.31)
    assert wait_for(lambda: "force 0.31 N" in report(demo) and page.inputs["tool"].value == HAND)
    visitor.set(page.inputs["direction right [deg]"], 20.0)
    visitor.set(page.inputs["place up [mm]"], -5.0)
    assert wait_for(lambda: demo.wish.touch == Touch(0.0, -5e-3, 0.31, (np.radians(20.0), 0.0), 2e-3))
    visitor.set(page.inputs["deformer"], "fem")
    assert wait_for(lambda: report(demo).startswith("**fem**: converged"))
    assert wait_for(lambda: "finite elements' own answer" in report(demo))
    visitor.set(page.inputs["deformer"], "svr")
    assert wait_for(lambda: report(demo).startswith("**svr**"))
    visitor.set(page.button, True)
    assert wait_for(lambda: not demo.wish.plays)
    assert wait_for(lambda: page.frame.value == demo.wish.number)  # at rest: nothing else moves the slider now
    number = (demo.wish.number + 7) % 120  # a slider that is there already is not moved
    visitor.set(page.frame, number)
    assert wait_for(lambda: f"frame {number}:" in report(demo) and page.inputs["tool"].value == SCRIPT)
    assert f"force {demo.stage.scene.path(number / 60).force:.2f} N" in report(demo)
    time.sleep(0.3)
    assert f"frame {number}:" in report(demo)


def test_the_menu_says_who_has_the_tool(demo):
    """The script gets the tool back while a slider's word that the hand has it is still on its way to the menu."""
    visitor, inputs = Visitor(demo.browser, 1200), demo.browser.inputs
    visitor.set(inputs["force [N]"], 0.2)
    assert wait_for(lambda: inputs["tool"].value == HAND)
    visitor.set(inputs["force [N]"], 0.3)
    visitor.set(inputs["tool"], SCRIPT)
    assert wait_for(lambda: demo.wish.tool == SCRIPT)
    time.sleep(0.3)
    assert inputs["tool"].value == demo.wish.tool
    visitor.wire.close()


class TestWish:
    def test_playing_goes_round(self):
        wish = Wish("linear", Touch(force=0.1))
        assert [self.played(wish) for _ in range(5)] == [0, 1, 2, 0, 1]
        wish.set(plays=False)
        assert [self.played(wish) for _ in range(3)] == [2, 2, 2]

    @staticmethod
    def played(wish):
        """The frame that is shown next, of three."""
        number = wish.now()[0]
        wish.go_on(number, 3)
        return number

    def test_who_seeks_is_not_overruled_by_the_frame_that_is_being_drawn(self):
        wish = Wish("linear", Touch())
        wish.set(number=2)
        wish.go_on(0, 3)
        assert wish.now()[0] == 2

    def test_the_hand_holds_what_it_does_not_change(self):
        wish = Wish("linear", Touch(force=0.1))
        assert wish.now()[2] is None
        wish.hand(x=0.01)
        assert wish.now()[2] == Touch(x=0.01, force=0.1)
        wish.hand(force=0.3)
        assert wish.now()[2] == Touch(x=0.01, force=0.3)
        wish.set(tool=SCRIPT, deformer="fem")
        assert wish.now()[1:3] == ("fem", None)

    def test_two_sliders_at_once_both_count(self):
        """The page calls each slider on a thread of its own."""
        wish = Wish("linear", Touch(force=0.1))
        hands = [threading.Thread(target=wish.hand, kwargs=turn) for turn in ({"right": 0.2}, {"up": -0.3})]
        with wish.lock:  # both are under way before either is heard
            for hand in hands:
                hand.start()
            time.sleep(0.05)
        for hand in hands:
            hand.join()
        assert wish.now()[2] == Touch(force=0.1, tilt=(0.2, -0.3))


def test_the_referee_answers_the_newest_question(theatre, scene):
    referee = Referee(theatre, scene)
    for number in range(60):
        referee.ask(number, None)
    assert wait_for(lambda: referee.truth is not None and referee.truth.number == 59)
    truth = referee.truth
    assert truth is not None and truth.deformation.time[0] == truth.loads.times[0] == scene.times[59]
    assert truth.deformation.outcome[0].good and truth.seconds > 0.0
    referee.close()
    assert not referee.thread.is_alive()


def test_a_page_that_cannot_be_served_leaves_nothing_behind(theatre, scene):
    before = set(threading.enumerate())
    for host, port, kind in (("127.0.0.1", 70000, ValueError), ("no.such.host.invalid", 8080, OSError)):
        with pytest.raises(kind):
            Demo(theatre, scene, "linear", host, port)
        with pytest.raises(kind):
            Browser([], None, None, host=host, port=port)  # type: ignore[arg-type]
    assert set(threading.enumerate()) <= before
