"""Controls of the page: sliders, styles, scenes and manual control of the tool."""

from typing import cast

import numpy as np
import pytest
from theatres import short, sinking, small

from ar.page.parts import Dropdown, Folder, Slider
from scenes.page.controls import build_controls, is_animated
from scenes.page.effect_costs import build_effect_switches
from scenes.page.requests import Requests
from scenes.page.side_panels import TIP
from scenes.script.scene import find_scene
from scenes.script.tool_paths import Touch

ACTIONS = print, print, Folder("physics effects", ()), print


class TestControls:
    def test_position_sliders_end_at_the_bone_edge(self, theatre):
        scene, site = short(), theatre.site
        assert scene.tool is not None
        found = build_controls(scene, site, ("svr", "fem"), Requests("svr", Touch()), *ACTIONS)
        places = [control for control in found if isinstance(control, Slider) and control.label.startswith("place")]
        room = site.clearance - scene.tool.radius
        assert len(places) == 2 and all(0.5 <= control.upper <= max(0.5, 1e3 * room) for control in places)
        assert all(control.lower == -control.upper and control.hint for control in places)
        assert all(any(f"to {letter}" in control.text for letter in "LRAPSI") for control in places)

    def test_effect_switches_have_readable_labels(self, theatre):
        for name in ("press", "palpate", "retract", "brain_shift", "pulsation"):
            found = build_controls(small(name), theatre.site, ("fem",), Requests("fem", Touch()), *ACTIONS)
            folds = *found, build_effect_switches(theatre, small(name), Requests("fem", Touch()), print)
            switches = [inner for control in folds if isinstance(control, Folder) for inner in control.controls]
            assert switches and all(inner.text and inner.text != inner.label for inner in switches)

    def test_overlay_control_comes_before_tool_sliders(self, theatre):
        labels = [
            control.label
            for control in build_controls(short(), theatre.site, ("fem",), Requests("fem", Touch()), *ACTIONS)
        ]
        assert labels[:5] == ["scene", "deformer", "overlay", "camera", "tool"] and labels[-7:-5] == [
            "slices",
            "registration",
        ]

    def test_overlay_control_offers_each_style(self, theatre):
        wish = Requests("fem", Touch())
        found = build_controls(short(), theatre.site, ("fem",), wish, *ACTIONS)
        overlay = next(control for control in found if isinstance(control, Dropdown) and control.label == "overlay")
        seen = []
        for option in overlay.options:
            overlay.on_change(option)
            seen.append(wish.style)
        assert seen[:3] == ["window", "contour", "fill"] and overlay.initial == overlay.options[0]

    def test_camera_and_slice_choices_are_offered(self, theatre):
        asks = Requests("fem", Touch())
        found = {control.label: control for control in build_controls(short(), theatre.site, ("fem",), asks, *ACTIONS)}
        camera, slices = found["camera"], found["slices"]
        assert isinstance(camera, Dropdown) and isinstance(slices, Dropdown)
        seen = []
        for option in camera.options:
            camera.on_change(option)
            seen.append(asks.path)
        assert seen == ["", "stays", "hand-held", "microscope", "orbit"]
        slices.on_change(TIP)
        tilt, distance = cast(Folder, found["camera position"]).controls
        assert isinstance(tilt, Slider) and isinstance(distance, Slider) and distance.initial == 300.0
        tilt.on_change(20.0)
        distance.on_change(200.0)
        assert asks.display == ("window", "orbit", TIP, pytest.approx(-np.radians(20.0)), pytest.approx(0.2), None)
        registration = cast(Dropdown, found["registration"])
        assert registration.options == ("perfect registration", "clinical registration, 1.6 mm per axis")
        registration.on_change(registration.options[1])
        assert registration.initial == registration.options[0] and asks.display.registration == "clinical"
        assert "slices" not in {
            each.label for each in build_controls(sinking(), theatre.site, ("fem",), asks, *ACTIONS)
        }

    def test_is_animated_is_true_for_time_dependent_scenes(self, theatre):
        found = {
            name: is_animated(find_scene(name), theatre.site) for name in ("press", "palpate", "retract", "pulsation")
        }
        assert found == {"press": False, "palpate": False, "retract": True, "pulsation": True}


class TestHand:
    def test_manual_control_pauses_the_script_until_play(self):
        wish = Requests("svr", Touch())
        wish.set_manual_input(force=0.2)
        assert not wish.plays and wish.read_current()[2] == Touch(force=0.2)
        wish.play(True)
        assert wish.plays and wish.read_current()[2] is None

    def test_manual_tool_is_kept_during_play_of_timed_scene(self):
        wish = Requests("fem", Touch(), clocked=True)
        wish.set_manual_input(depth=1e-3)
        wish.play(True)
        assert wish.plays and wish.read_current()[2] == Touch(depth=1e-3)
