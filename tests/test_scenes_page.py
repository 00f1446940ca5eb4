"""What the page says and offers: the words of an answer and of a brain; sliders that the opening allows."""

import time
from dataclasses import replace

import numpy as np
import pytest
from theatres import short, sinking, small

from ar.page.parts import Choice, Fold, Slider
from scenes.page.beside import TIP, TUMOUR_MIDDLE, lines_of, sample_of, slices_of
from scenes.page.controls import clocked, controls
from scenes.page.referee import Truth
from scenes.page.requests import Wish
from scenes.page.text import RESEARCH, about, fem_words, plan_words, report, side, trust, words
from scenes.page.verdict import judge, verdict_words
from scenes.play.deformers import GUARDED, plan_of
from scenes.play.player import Player
from scenes.play.stage import Stage
from scenes.play.waiting_notice import NOTICED, Busy
from scenes.script.scene import find_scene
from scenes.script.tool_paths import Touch, press
from scenes.script.uncertainty import TumourError
from sim.accuracy import LIVE
from sim.deformation import Outcome, guess
from sim.effects import Elasticity, Held, Slide, ToolForce
from sim.material import Material
from surrogate.data.dataset import digest_of_loads


def answer(outcome: Outcome, bound: float = 1e-3):
    return replace(guess(np.full((1, 3, 3), 1e-3)), outcome=(outcome,), bound=np.array([[bound], [2.0 * bound]]))


class TestTrust:
    def test_a_bound_is_reported_of_a_load_inside_the_range(self):
        said = trust(answer(Outcome.PREDICTED), "svr")
        assert (
            "in 95 of 100 loads" in said and "Error of the model" in said and "1.00 mm" in said and "warn" not in said
        )

    @pytest.mark.parametrize(
        "outcome", [Outcome.EXTRAPOLATED, Outcome.BUDGET, Outcome.STALLED, Outcome.NOT_FINITE, Outcome.PIERCED]
    )
    def test_nothing_is_promised_of_an_answer_that_is_not_good(self, outcome):
        """It stands in another colour, with the reason."""
        said = trust(answer(outcome), "svr")
        assert "95 of 100" not in said and 'class="warn"' in said and "Do not rely on this answer" in said

    def test_a_guarded_model_says_which_of_the_two_answered(self):
        assert trust(answer(Outcome.PREDICTED), GUARDED).startswith(
            "<p><b>trained model (guarded)</b>: inside the range"
        )
        assert "as the trained model is unsure of this load</b>: solved" in trust(answer(Outcome.CONVERGED), GUARDED)

    def test_code_names_are_not_shown(self):
        for outcome in Outcome:
            said = trust(answer(outcome), "fem")
            assert "_" not in said and outcome.name not in said

    @pytest.mark.parametrize(("bound", "words"), [(1e-7, "0.01 mm"), (6e-6, "0.01 mm"), (1.231e-3, "1.24 mm")])
    def test_a_bound_is_not_reported_too_small(self, bound, words):
        bounded = replace(answer(Outcome.PREDICTED), bound=np.full((2, 1), bound))
        assert f"is more than {words} from where its finite elements have it" in trust(bounded, "svr")

    def test_undeformed_brain_has_no_motion_and_no_error_of_it(self, theatre):
        scene = small(path=press(0.2), duration=1.0)
        player = Player(theatre.stage(scene), theatre.deformer("linear", scene))
        frames = [player.draw(0, time, player.scene.path(time)) for time in (0.0, 0.9)]
        said = [report(frame, player.stage, "linear", "", (), 2) for frame in frames]
        assert "tumour moved" not in said[0] and "Nothing moves the tumour" in said[0]
        assert "tumour moved" in said[1] and "Nothing moves" not in said[1]

    def test_where_nothing_moves_nothing_is_promised(self):
        still = answer(Outcome.PREDICTED)
        still = replace(still, displacement=0.0 * still.displacement)
        said = trust(still, "svr")
        assert "Nothing moves the tumour." in said and "95 of 100" not in said


class TestDigestOfLoads:
    def test_it_is_of_the_load_and_not_of_the_frame(self, theatre):
        scene, site = short(), theatre.site
        one = digest_of_loads(scene.loads(site, Touch(force=0.2), 0.1))
        assert one == digest_of_loads(scene.loads(site, Touch(force=0.2), 0.1))
        others = [Touch(force=0.21), Touch(force=0.2, x=0.004), Touch(force=0.2, tilt=(0.3, 0.0))]
        assert one not in {digest_of_loads(scene.loads(site, touch, 0.1)) for touch in others}
        assert one != digest_of_loads(scene.loads(site, Touch(force=0.2), 0.2))


class TestWords:
    def test_it_says_what_is_seen_and_that_it_is_research(self, theatre):
        said = words(theatre, short(), "the <default> brain")
        assert RESEARCH in said and "&lt;default&gt;" in said and "<default>" not in said
        assert "tumour now" in said and "tumour in the scan" in said and "tip to tumour" in said
        assert "tip to tumour" not in words(theatre, sinking(), "brain")

    def test_tissue_and_element_are_those_that_are_solved(self, theatre):
        default = "smoothed linear tetrahedra, neo-hookean tissue of Young's modulus 3 kPa"
        assert fem_words(theatre, short()).startswith(default)
        stiff = Elasticity(Material("corotational", 5e3, 0.4, prony=()))
        plain = replace(theatre, models={})
        other = replace(short(), effects=(stiff, Held(), Slide(), ToolForce()), element="smoothed")
        assert fem_words(plain, other) == (
            "smoothed linear tetrahedra, corotational tissue of Young's modulus 5 kPa and Poisson's ratio 0.4"
        )
        assert fem_words(plain, find_scene("retract")).endswith("relaxes under a held load")
        assert fem_words(plain, find_scene("sag")).endswith(
            "Young's modulus 1.8 kPa and Poisson's ratio 0.45; the tumour of neo-hookean tissue of Young's modulus "
            "3.2 kPa and Poisson's ratio 0.45"
        )
        assert "brain.vtu, opened" in about(theatre, short(), "brain.vtu")

    def test_a_plan_is_a_list_and_only_finite_elements_have_one(self, theatre):
        assert plan_words(("First <this>.", "Then that.")) == "<ul><li>First &lt;this&gt;.</li><li>Then that.</li></ul>"
        assert plan_words(()) == "" == plan_words(plan_of(theatre.models["linear"]))
        scene = small("resection")
        assert plan_of(theatre.fem(scene, scene.accuracy)) == ()
        assert plan_of(theatre.fem(short(), LIVE)) == theatre.fem(short(), LIVE).plan.explain()

    def test_the_side_is_the_patient_s(self, theatre):
        site = theatre.site
        middle = 0.5 * (site.anatomy.mesh.nodes[:, 0].min() + site.anatomy.mesh.nodes[:, 0].max())
        at = [replace(site, origin=np.array([middle + x, 0.0, 0.0])) for x in (0.02, -0.02, 0.0)]
        assert [side(place) for place in at] == [
            "on the patient's right",
            "on the patient's left",
            "near the midline",
        ]


class TestControls:
    def test_the_sliders_end_where_the_bone_stops_the_tool(self, theatre):
        scene, site = short(), theatre.site
        assert scene.tool is not None
        found = controls(scene, site, ("svr", "fem"), Wish("svr", Touch()), print, print)
        places = [control for control in found if isinstance(control, Slider) and control.label.startswith("place")]
        room = site.clearance - scene.tool.radius
        assert len(places) == 2 and all(0.5 <= control.high <= max(0.5, 1e3 * room) for control in places)
        assert all(control.low == -control.high and control.hint for control in places)
        assert all(any(f"to {letter}" in control.words for letter in "LRAPSI") for control in places)

    def test_no_code_name_is_shown(self, theatre):
        for name in ("press", "palpate", "retract", "brain_shift", "pulsation"):
            found = controls(small(name), theatre.site, ("fem",), Wish("fem", Touch()), print, print)
            switches = [inner for control in found if isinstance(control, Fold) for inner in control.controls]
            assert switches and all(inner.words and inner.words != inner.label for inner in switches)

    def test_the_overlay_comes_before_the_tool_s_sliders(self, theatre):
        labels = [
            control.label for control in controls(short(), theatre.site, ("fem",), Wish("fem", Touch()), print, print)
        ]
        assert labels[:5] == ["scene", "deformer", "overlay", "camera", "tool"] and labels[-4] == "slices"

    def test_every_overlay_style_is_offered(self, theatre):
        wish = Wish("fem", Touch())
        found = controls(short(), theatre.site, ("fem",), wish, print, print)
        overlay = next(control for control in found if isinstance(control, Choice) and control.label == "overlay")
        seen = []
        for option in overlay.options:
            overlay.changed(option)
            seen.append(wish.style)
        assert seen[:3] == ["window", "contour", "fill"] and overlay.start == overlay.options[0]

    def test_each_way_of_the_camera_and_each_place_of_the_slices_is_offered(self, theatre):
        wish = Wish("fem", Touch())
        found = {control.label: control for control in controls(short(), theatre.site, ("fem",), wish, print, print)}
        camera, slices = found["camera"], found["slices"]
        assert isinstance(camera, Choice) and isinstance(slices, Choice)
        seen = []
        for option in camera.options:
            camera.changed(option)
            seen.append(wish.path)
        assert seen == ["", "stays", "hand-held", "microscope", "orbit"]
        slices.changed(TIP)
        assert wish.look == ("window", "orbit", TIP)
        assert "slices" not in {each.label for each in controls(sinking(), theatre.site, ("fem",), wish, print, print)}

    def test_which_scenes_go_on_by_themselves(self, theatre):
        found = {name: clocked(find_scene(name), theatre.site) for name in ("press", "palpate", "retract", "pulsation")}
        assert found == {"press": False, "palpate": False, "retract": True, "pulsation": True}


class TestHand:
    def test_a_still_hand_pauses_the_script_and_play_takes_the_tool_back(self):
        wish = Wish("svr", Touch())
        wish.hand(force=0.2)
        assert not wish.plays and wish.now()[2] == Touch(force=0.2)
        wish.play(True)
        assert wish.plays and wish.now()[2] is None

    def test_where_time_goes_on_the_hand_keeps_the_tool(self):
        wish = Wish("fem", Touch(), clocked=True)
        wish.hand(depth=1e-3)
        wish.play(True)
        assert wish.plays and wish.now()[2] == Touch(depth=1e-3)


def test_a_long_wait_is_reported_and_a_short_one_is_not():
    said: list[str] = []
    busy = Busy(said.append)
    busy.on("a quick load")
    busy.off()
    time.sleep(NOTICED + 0.3)
    assert said == []
    busy.on("solving the first half")
    busy.on("solving the second half")
    time.sleep(NOTICED + 0.3)
    busy.off()
    busy.close()
    assert said[0].startswith("solving the second half") and said[-1] == "" and "" not in said[:-1]


def test_a_verdict_is_the_error_in_millimetres(theatre):
    """Of a model whose answer is 0.2 mm off everywhere, and of the finite elements' own distance."""
    scene = short()
    whole = Player(Stage(scene, theatre.site), theatre.fem(scene, LIVE))
    loads = whole.loads(3)
    answer = whole.answer(loads)

    class Off:
        def deform(self, loads, start=None, at=None):
            found = whole.deformer.deform(loads, at=at)
            return replace(found, displacement=found.displacement + [0.0, 0.2e-3, 0.0])

    found = judge(Truth(3, loads, answer, 0.5), replace(whole, deformer=Off()), own=False)
    said = verdict_words(found, stale=False, waits="")
    assert "error against FEM: mean 0.200, largest 0.200 mm; tip to tumour " in said
    tip = whole.drawn(3, whole.touch(3), loads, answer, 0.0).distance
    assert f"tip to tumour {1e3 * tip:.1f} mm, tumour moved " in said and "FEM 500 ms" in said
    assert " by FEM, without the error of the tumour (" in said
    assert verdict_words(found, stale=True, waits="").startswith('<p class="stale">of an earlier load: ')


def test_the_chart_and_the_slices_are_of_the_frame_that_is_shown(theatre):
    player = theatre.player("linear", short())
    frame = player.draw(3, 0.1, Touch(force=0.25))
    read = sample_of(replace(frame, distance=12e-3, distance_error=np.inf), player.scene, 5.0)
    assert read.values == pytest.approx((12.0, 0.25)) and read.errors == (None, 0.0) and read.time == 5.0
    assert sample_of(replace(frame, distance_error=2e-3), player.scene, 0.0).errors[0] == pytest.approx(2.0)
    middle, tip = (slices_of(frame, player, place) for place in (TUMOUR_MIDDLE, TIP))
    assert middle.shape == tip.shape and (middle != tip).any()
    known = slices_of(replace(frame, tumour_error=TumourError(4e-3)), player, TUMOUR_MIDDLE)
    doubtful = slices_of(replace(frame, tumour_error=TumourError(4e-3), doubt="why"), player, TUMOUR_MIDDLE)
    green = [np.count_nonzero(each[..., 1] > each[..., 0] + 10.0) for each in (known, middle, doubtful)]
    assert green[0] > 1.5 * green[1] > 0 == green[2]
    still = theatre.player("fem", sinking())
    assert [line.name for line in lines_of(still.scene)] == ["tumour moved"]
    moved = sample_of(replace(frame, moved=3e-3, tumour_error=TumourError(4e-3)), still.scene, 0.0)
    assert moved.values == (3.0,) and moved.errors == (4.0,)


def test_the_page_reads_what_the_frame_holds(theatre):
    """Distance, motion, force and milliseconds, and whose error is how large, each as a person reads it."""
    player = theatre.player("linear", short())
    seconds = {"deform": 12.3e-3, "render": 4.5e-3, "overlay": 0.7e-3}
    known = {
        "distance": 12.34e-3,
        "distance_error": 2.46e-3,
        "moved": 1.234e-3,
        "model_error": 11e-6,
        "seconds": seconds,
    }
    frame = replace(player.draw(3, 0.1, Touch(force=0.25)), **known)
    said = report(frame, player.stage, "linear", "", (), 7)
    for line in (
        ">tip to tumour 12.3&nbsp;mm<",
        "<p>frame 3 of 6; 0.10 s; force 0.25 N; tumour moved 1.23 mm (error of the model 0.02 mm, "
        "error of the tumour not known); ",
        "; tip to tumour within 2.5 mm of the model&#x27;s finite elements (95 %)</p>",
        "<p>Error of the tumour: not known.",
        "milliseconds: answer 12.3, camera picture 4.5, overlay 0.7<",
    ):
        assert line in said
    plain = report(replace(frame, distance_error=None), player.stage, "linear", "", (), 7)
    assert "tip to tumour 12.3&nbsp;mm<" in plain and "tip to tumour within" not in plain
    within = report(replace(frame, inside=True), player.stage, "linear", "", (), 7)
    assert ">tip inside the tumour, its edge 12.3&nbsp;mm<" in within and ">tip to tumour" not in within
    known = TumourError(4.61e-3, "E"), TumourError(4.61e-3, "E", 1.11e-3)
    prior, seen = (report(replace(frame, tumour_error=one), player.stage, "linear", "", (), 7) for one in known)
    where = "95 of 100 times no point of it is more than"
    assert f"<p>Error of the tumour: {where} 4.7 mm from where it is; the largest part is E.</p>" in prior
    assert f"<p>Error of the tumour: {where} 1.2 mm from where it is; without observation 4.7 mm.</p>" in seen
    guess = report(replace(frame, tumour_error=replace(known[0], guess=True)), player.stage, "linear", "", (), 7)
    assert f"{where} 4.7 mm from where it is: a guess, of few draws or" in guess and "largest part" not in guess
    for said, off in ((prior, "4.7"), (seen, "1.2")):
        assert f"tip to tumour 12.3&nbsp;±&nbsp;{off}&nbsp;mm<" in said
    surely = report(replace(frame, moved_error=5.31e-3, model_error=None), player.stage, "fem", "", (), 7)
    assert "; tumour moved 1.23 mm (error of the tumour 5.4 mm); " in surely
    doubted = replace(frame, tumour_error=known[0], doubt="why", model_error=None)
    assert "(error of the answer not known)" in report(doubted, player.stage, "linear", "", (), 7)
    assert "tip to tumour 12.3&nbsp;mm<" in report(doubted, player.stage, "linear", "", (), 7)
