"""What the page says and offers: the words of an answer and of a brain; sliders that the opening allows."""

from dataclasses import replace

import numpy as np
import pytest
from theatres import short, sinking, small

from ar.page.parts import Choice, Fold, Slider
from scenes.page.beside import TIP, TUMOUR_MIDDLE, lines_of, sample_of, slices_of
from scenes.page.controls import clocked, controls
from scenes.page.requests import Wish
from scenes.page.text import report
from scenes.script.scene import find_scene
from scenes.script.tool_paths import Touch
from scenes.script.uncertainty import TumourError
from sim.deformation import Outcome, guess
from surrogate.data.dataset import digest_of_loads


def answer(outcome: Outcome, bound: float = 1e-3):
    return replace(guess(np.full((1, 3, 3), 1e-3)), outcome=(outcome,), bound=np.array([[bound], [2.0 * bound]]))


class TestDigestOfLoads:
    def test_it_is_of_the_load_and_not_of_the_frame(self, theatre):
        scene, site = short(), theatre.site
        one = digest_of_loads(scene.loads(site, Touch(force=0.2), 0.1))
        assert one == digest_of_loads(scene.loads(site, Touch(force=0.2), 0.1))
        others = [Touch(force=0.21), Touch(force=0.2, x=0.004), Touch(force=0.2, tilt=(0.3, 0.0))]
        assert one not in {digest_of_loads(scene.loads(site, touch, 0.1)) for touch in others}
        assert one != digest_of_loads(scene.loads(site, Touch(force=0.2), 0.2))


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
