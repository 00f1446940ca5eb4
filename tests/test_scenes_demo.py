"""Page of `sulcus demo` without a browser: playback, comparison with FEM, controls and shutdown."""

import threading
import time

import numpy as np
import pytest
from visitor import Visitor, report, run_until, wait_for

from ar.overlay.hud import TEXT_SCALE
from ar.overlay.outlines import has_text
from ar.page.browser import Browser
from scenes.page.comparison import PageState
from scenes.page.controls import PLAN
from scenes.page.demo import Demo
from scenes.page.requests import HAND, SCRIPT
from scenes.page.text import format_solver_list
from scenes.script.tool_paths import Touch
from sim.fem import Fem
from surrogate.model.learned import Learned


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


def test_demo_plays_and_shows_difference_from_fem(demo, theatre):
    assert demo.run(2.0) > 1
    demo.wish.set(plays=False)
    # The error belongs to the frame that the finite elements answered, and says which.
    assert wait_for(lambda: demo.run(0.3) and f"; frame {demo.wish.number}, FEM" in report(demo))
    text = report(demo)
    assert "difference from FEM: mean" in text
    assert "|fast model (linear)|: inside the range" in text and "tip to tumour" in text and "time [ms]: " in text
    truth = demo.fem_worker.truth
    assert truth.number == demo.wish.number
    nodes = theatre.anatomy.tumour_nodes
    scene = demo.stage.scene
    loads = scene.build_loads(theatre.site, scene.path(scene.times[truth.number]), scene.times[truth.number])
    assert np.array_equal(loads.causes[0].force, truth.loads.causes[0].force)
    off = (
        theatre.models["linear"].deform(loads, at=nodes).displacement[0]
        - truth.deformation.restrict(nodes).displacement[0]
    )
    assert f"mean {1e3 * np.linalg.norm(off, axis=1).mean():.3f}" in text
    assert demo.browser.shown[1].shape == (240, 320, 3)
    assert len(np.unique(demo.browser.shown[1])) > 50


def test_demo_shows_the_solver_plan_of_fem(demo, monkeypatch):
    """With a model and with FEM as deformer; nothing for deformers without a plan."""
    folder, text = demo.browser.controls.notes[PLAN]
    assert not folder.visible
    demo.wish.set(plays=False)
    assert wait_for(lambda: demo.run(0.3) and folder.visible)
    assert demo.fem_worker.plan and format_solver_list(demo.fem_worker.plan) in text.content
    assert "Newton-CG" in text.content and text.content.count("<li>") == len(demo.fem_worker.plan)
    demo.wish.set(deformer="fem")
    assert wait_for(lambda: demo.run(0.3) and "result of the FEM solver" in report(demo) and folder.visible)
    monkeypatch.setattr(demo.fem_worker, "plan", ())
    assert wait_for(lambda: demo.run(0.3) and not folder.visible)


def test_page_text_and_image_have_the_same_frame_number(demo, monkeypatch):
    shown = []
    monkeypatch.setattr(demo.browser, "show", lambda *said: shown.append(said[:3]))
    demo.run(1.0)
    assert len({number for number, _, _ in shown}) > 3
    pictures = {}
    for number, colour, words in shown:
        assert f"frame {number} of" in words and has_text(colour, f"frame {number}", TEXT_SCALE)
        assert pictures.setdefault(number, colour) is colour


def test_play_continues_from_the_paused_frame(demo, monkeypatch):
    """Inside a run: the paused frame is shown already, and no new solution is requested."""
    demo.wish.set(plays=False, number=20)
    seen = []

    def played():
        seen.append(demo.wish.number)
        if len(seen) == 5:
            demo.wish.play(True)
        return seen[-1] > 22 or len(seen) == 100

    run_until(demo, monkeypatch, played)
    assert seen[:5] == [20] * 5 and seen[-1] == 23


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_demo_reports_failed_fem_solver(demo, monkeypatch):
    def overflowing(fem, loads, start=None, at=None):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(Fem, "deform", overflowing)
    assert wait_for(lambda: demo.run(0.3) and "do not solve any more (out of memory)" in report(demo))


def test_error_is_computed_once_per_fem_solution(demo, monkeypatch):
    demo.wish.set(plays=False, number=30)
    answer, asked = Learned.deform, []

    def counted(model, loads, start=None, at=None):
        asked.append(model)
        return answer(model, loads, start, at)

    monkeypatch.setattr(Learned, "deform", counted)
    run_until(demo, monkeypatch, lambda: "difference from FEM: mean" in report(demo))
    shown = demo.cast.get_player(demo.wish.deformer).deformer
    assert sum(model is shown for model in asked) == 2  # for the picture, and for the error


def test_visitor_can_move_tool_select_frame_and_deformer(running):
    demo, visitor = running
    page = demo.browser
    visitor.set(page.inputs["force [N]"], 0.31)
    assert wait_for(lambda: "force 0.31 N" in report(demo) and page.inputs["tool"].value == HAND)
    visitor.set(page.inputs["direction right [deg]"], 20.0)
    visitor.set(page.inputs["place up [mm]"], -5.0)
    assert wait_for(lambda: demo.wish.touch == Touch(0.0, -5e-3, 0.31, (np.radians(20.0), 0.0)))
    visitor.set(page.inputs["deformer"], "FEM (reference)")
    assert wait_for(lambda: "|FEM (reference)|: converged" in report(demo))
    assert wait_for(lambda: "result of the FEM solver" in report(demo))
    visitor.set(page.inputs["deformer"], "fast model (svr)")
    assert wait_for(lambda: "|fast model (svr)|" in report(demo))
    assert not demo.wish.plays  # nothing moves under a hand that is still
    assert wait_for(lambda: page.button.label == "Play" and page.frame.value == demo.wish.number)
    number = (demo.wish.number + 7) % 120  # a slider that is there already is not moved
    visitor.set(page.frame, number)
    assert wait_for(lambda: f"frame {number} of 120" in report(demo) and page.inputs["tool"].value == SCRIPT)
    assert f"force {demo.stage.scene.path(number / 60).force:.2f} N" in report(demo)
    time.sleep(0.3)
    assert f"frame {number} of 120" in report(demo)


def test_tool_menu_shows_who_controls_the_tool(demo):
    """Case: the script takes the tool while a slider's message of manual control is still being processed."""
    visitor, inputs = Visitor(demo.browser, 1200), demo.browser.inputs
    visitor.set(inputs["force [N]"], 0.2)
    assert wait_for(lambda: inputs["tool"].value == HAND)
    visitor.set(inputs["force [N]"], 0.3)
    visitor.set(inputs["tool"], SCRIPT)
    assert wait_for(lambda: demo.wish.tool == SCRIPT)
    time.sleep(0.3)
    assert inputs["tool"].value == demo.wish.tool
    visitor.wire.close()


def test_demo_at_invalid_address_leaves_no_threads(theatre, scene):
    before = set(threading.enumerate())
    for host, port, kind in (("127.0.0.1", 70000, ValueError), ("no.such.host.invalid", 8080, OSError)):
        with pytest.raises(kind):
            Demo(theatre, scene, "linear", host, port)
        with pytest.raises(kind):
            Browser([], None, None, host=host, port=port)  # type: ignore[arg-type]
    assert set(threading.enumerate()) <= before


def test_scene_change_keeps_the_page_address(demo):
    page, address = demo.browser, demo.browser.address
    assert demo.run(0.3) >= 1 and "tool" in page.meshes
    demo.wish.set(scene="brain_shift", plays=False, deformer="fem")
    assert wait_for(lambda: demo.run(0.5) and "gravity towards" in report(demo))
    assert demo.stage.scene.name == "brain_shift" and "tool" not in page.meshes and "force [N]" not in page.inputs
    assert "fluid drains" in page.words.content and page.address == address
    demo.wish.set(scene="press")
    assert wait_for(lambda: demo.run(0.5) and "force 0." in report(demo))
    assert demo.stage.scene is demo.first and page.inputs["scene"].value == "press"
    assert (
        demo.wish.deformer == demo.patient.select_default(demo.first) != "fem"
    )  # its own, not that of the scene before


def test_unknown_scene_keeps_the_current_scene(demo):
    demo.wish.set(scene="no such scene")
    demo.run(0.5)
    assert demo.stage.scene is demo.first and demo.wish.scene == "press"
    assert wait_for(lambda: demo.run(0.3) and "force 0." in report(demo))


def test_style_change_does_not_solve_the_load_again(demo, monkeypatch):
    demo.wish.set(plays=False, number=30)
    asked = []
    answer = Learned.deform
    demo.run(0.3)
    assert wait_for(lambda: demo.run(0.3) and "|difference from FEM: mean" in report(demo))

    def counted(model, loads, start=None, at=None):
        asked.append(model)
        return answer(model, loads, start, at)

    moment = PageState()
    demo.update_page(moment)
    before = moment.image
    monkeypatch.setattr(Learned, "deform", counted)
    demo.wish.set(style="contour")
    demo.update_page(moment)
    assert before is not None and (moment.image != before).any() and asked == []
    before = moment.image
    for path, moves in (("orbit", True), ("stays", False)):
        demo.wish.set(path=path)
        demo.update_page(moment)
        assert (moment.image != before).any() == moves and asked == []


def test_images_are_coarse_in_motion_and_sharp_at_rest(demo):
    now = PageState(max_render_time=0.0, still_time=1.0)  # every renderer is slow
    demo.wish.set(plays=False, number=29)
    demo.update_page(now)
    assert not now.coarse  # nothing has moved yet
    demo.wish.set(number=30)
    demo.update_page(now)
    moving = now.frame
    assert now.coarse and moving is not None
    demo.update_page(now)
    assert now.coarse
    assert wait_for(lambda: demo.update_page(now) == 0 and not now.coarse)
    still = now.frame
    assert still is not None and (still.shown != moving.shown).any()
    assert still.shown.shape == moving.shown.shape and still.distance == moving.distance
    np.testing.assert_array_equal(still.tumour_error.bound, moving.tumour_error.bound)
    assert np.abs(still.shown.astype(int) - moving.shown).mean() < 4.0
    # A fast renderer always draws sharp images.
    now.max_render_time = 1e9
    demo.wish.set(number=31)
    demo.update_page(now)
    assert not now.coarse


def test_demo_reports_a_running_long_solve(demo, monkeypatch):
    answer, said = Learned.deform, []
    monkeypatch.setattr(demo.browser, "show_status", said.append)

    def slow(model, loads, start=None, at=None):
        time.sleep(0.8)
        return answer(model, loads, start, at)

    monkeypatch.setattr(Learned, "deform", slow)
    demo.wish.set(plays=False)
    demo.wish.set_manual_input(force=0.2)
    demo.run(0.2)
    assert said[0].startswith("computing the deformation for the manual tool, 0.20 N (fast model (linear))")
    assert said[-1] == ""


def test_model_predicts_while_fem_solves(demo, monkeypatch):
    solved, begun, deform = threading.Event(), [], Fem.deform

    def waiting(fem, loads, start=None, at=None):
        begun.append(round(60 * loads.times[0]))
        assert solved.wait(60.0)
        return deform(fem, loads, start, at)

    monkeypatch.setattr(Fem, "deform", waiting)
    demo.wish.set(plays=False, number=9, deformer="fem")
    assert wait_for(lambda: not demo.run(0.3) and begun == [9])
    demo.wish.set(deformer="svr")
    assert wait_for(lambda: demo.run(0.3) and "|fast model (svr)|" in report(demo)) and begun == [9]
    solved.set()
    assert wait_for(lambda: demo.run(0.3) and "|difference from FEM: mean" in report(demo)) and begun == [9]
