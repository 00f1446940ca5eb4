"""Effects of a scene: their causes, scenes without a tool, switches on the page, and brain shift."""

import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
from theatres import coarse_brain, player, short, sinking, small, template_theatre
from visitor import Visitor, free_port, wait_for

from scenes.episodes.episode import UNITS, collect
from scenes.page.demo import Demo
from scenes.play.checks import measure_frames
from scenes.play.deformers import PatientSetup
from scenes.play.effect_ablation import remove_effect
from scenes.play.frame_text import format_active_loads
from scenes.play.reference import solve_reference_frames
from scenes.play.scene_costs import draw_cost_panel
from scenes.play.stage import CORTEX, TOOL, Stage
from scenes.script.craniotomy_frame import HOLE_RATIO
from scenes.script.scene import Bounds, find_scene
from scenes.script.tool_paths import Touch
from sim.accuracy import TRAIN
from sim.deformation import build_start
from sim.effects import Elasticity, Gravity, Held, Slide, ToolForce
from sim.errors import InputError
from sim.loads import Loads, Posture, Pushed, build_posture, stack

EFFECTS = (Elasticity(), Held(), Slide())
STILL = build_start(np.zeros((1, 3, 3)))

CAMERA = "camera tilt [deg]", "camera distance [mm]"


@pytest.fixture(scope="module")
def frames(theatre):
    return list(player(theatre, sinking(), "fem").play_frames(3))


class TestCauses:
    @pytest.mark.parametrize(
        ("effects", "causes"),
        [
            (EFFECTS, []),
            ((*EFFECTS, ToolForce()), [Pushed]),
            ((*EFFECTS, Gravity()), [Posture]),
            ((*EFFECTS, Gravity(), ToolForce()), [Posture, Pushed]),
        ],
    )
    def test_loads_have_the_causes_of_the_scene_effects(self, theatre, effects, causes):
        loads = replace(short(), effects=effects).build_loads(theatre.site, Touch(force=0.2), 0.5)
        assert [type(cause) for cause in loads.causes] == causes and loads.times.tolist() == [0.5]

    def test_tool_force_in_scene_without_tool_is_rejected(self):
        with pytest.raises(InputError, match="has no tool"):
            replace(short(), tool=None)

    def test_acting_forces_are_described_in_text(self, theatre):
        both = replace(short(), effects=(*EFFECTS, Gravity(), ToolForce()))
        height = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.04]])  # from -32 to 0 mm against gravity
        words = format_active_loads(
            both.build_loads(theatre.site, Touch(force=0.2), 0.0), STILL, theatre.site.anatomy.mesh.nodes
        )
        assert "force 0.20 N" in words and "gravity towards the back, CSF level" in words
        idle = format_active_loads(
            both.build_loads(theatre.site, Touch(force=0.0), 0.0), STILL, theatre.site.anatomy.mesh.nodes
        )
        assert "the tool does not push" in idle and "force" not in idle
        assert format_active_loads(Loads((), np.zeros(1)), STILL, height) == ""
        lying = build_posture(np.array([-3.0, 0.0, 4.0]), -0.012)
        way = "gravity towards the crown, 37 deg left, CSF level "
        assert format_active_loads(lying, STILL, height) == way + "62 %"


STUDIES = "measure costs", "refine the error"


class TestWithoutATool:
    def test_scene_without_tool_draws_no_tool_and_no_distance(self, frames, monkeypatch):
        for frame in frames:
            assert frame.pose is frame.tip is frame.distance is None
            assert not (frame.picture.segmentation == TOOL).any()
            assert (frame.shown != frame.picture.colour).any()
        lines = []
        monkeypatch.setattr(
            "scenes.play.scene_costs.draw_text_panel", lambda colour, text, **given: lines.extend(text) or colour
        )
        draw_cost_panel(frames[-1], "fem")
        assert any(re.search(r"towards the left, 30 deg back, CSF level \d+ %", line) for line in lines)
        assert not any("0.00 N" in line for line in lines)

    def test_scene_without_tool_passes_the_checks(self, theatre, frames):
        play = player(theatre, sinking(), "fem")
        figures = measure_frames(
            play,
            play.get_camera,
            frames,
            solve_reference_frames(theatre, play.scene, [frame.loads for frame in frames]),
        )
        assert not figures.find_violations(Bounds()) and figures.motion_mm > 0.01

    def test_episode_of_scene_without_tool_stores_posture(self, theatre, tmp_path):
        collect(tmp_path / "a.h5", theatre, player(theatre, sinking(), "fem"), "fem", iter)
        with h5py.File(tmp_path / "a.h5") as file:
            assert not {"force", "contact", "tip", "T_world_tool"} & set(file)
            assert file["direction"].shape == (7, 3) and file["csf_level"].shape == (7,)
            assert file["csf_level"].attrs["unit"] == UNITS["csf_level"] == "m"
            assert np.diff(file["csf_level"][:4]).max() < 0.0

    def test_page_of_scene_without_tool_has_no_tool_controls(self, theatre):
        demo = Demo(theatre, sinking(), "fem", "127.0.0.1", free_port())
        try:
            assert (
                set(demo.browser.inputs)
                == {"scene", "deformer", "overlay", "camera", "registration", *CAMERA, "Gravity", *STUDIES}
                and "tool" not in demo.browser.meshes
            )
            assert wait_for(lambda: demo.run(0.3) and "gravity towards" in demo.browser.shown[2])
            assert "tip to tumour" not in demo.browser.shown[2]
        finally:
            demo.close()


class TestSwitches:
    @pytest.fixture
    def demo(self, theatre):
        scene = replace(short(), effects=(*short().effects, Gravity()), lying=sinking().lying)
        demo = Demo(theatre, scene, "fem", "127.0.0.1", free_port())
        demo.wish.set(plays=False, number=5)
        yield demo
        demo.close()

    def test_page_reports_change_when_effects_are_switched(self, demo, theatre):
        page, visitor = demo.browser, Visitor(demo.browser, 1200)
        assert {"ToolForce", "Gravity"} < set(page.inputs) and not {"Held", "Elasticity"} & set(page.inputs)
        assert wait_for(lambda: demo.run(0.3) and "result of the FEM solver" in page.shown[2])
        visitor.set(page.inputs["Gravity"], False)
        words = "without gravity and CSF the tumour position differs"
        assert wait_for(lambda: demo.run(0.3) and words in page.shown[2])
        said = float(page.shown[2].split("position differs by ")[1].split(" mm")[0])
        scene, nodes = demo.stage.scene, theatre.anatomy.tumour_nodes
        plain, less = replace(theatre, models={}), remove_effect(scene, Gravity())
        one, other = (
            plain.build_fem(each, TRAIN)
            .deform(each.build_loads(theatre.site, each.path(5 / 30), 5 / 30))
            .restrict(nodes)
            .displacement[0]
            for each in (scene, less)
        )
        change = 1e3 * np.linalg.norm(one - other, axis=1).mean()
        assert change > 0.1 and said == pytest.approx(change, abs=0.02)
        assert "gravity towards" not in page.shown[2]
        visitor.set(page.inputs["Gravity"], True)
        assert wait_for(lambda: demo.run(0.3) and "result of the FEM solver" in page.shown[2])
        visitor.wire.close()

    def test_tumour_does_not_move_with_all_effects_off(self, demo):
        demo.wish.switch_effect("Gravity", False)
        demo.wish.switch_effect("ToolForce", False)
        assert wait_for(
            lambda: demo.run(0.3) and "without gravity and CSF, push of the tool the" in demo.browser.shown[2]
        )
        assert "Nothing moves the tumour" in demo.browser.shown[2]
        demo.wish.switch_effect("Gravity", True)
        assert demo.wish.off == {"ToolForce"}


@pytest.fixture(scope="module")
def coarse():
    """The brain that ships, on fewer nodes."""
    return PatientSetup(coarse_brain(), None, {}, "cpu")


class TestBrainShift:
    def test_brain_shift_matches_published_patient_range(self, coarse):
        """Cortex 6.1 +- 3.4 mm in 61 patients; 5.1, and the tumour 3.5, over 1,000 computed cases."""
        theatre, anatomy, scene = coarse, coarse.anatomy, find_scene("brain_shift")
        fem, cortex = theatre.build_fem(scene, scene.accuracy), np.unique(anatomy.open_surface)
        lying = {time: scene.build_loads(theatre.site, scene.path(time), time) for time in (0.0, 1.5, 3.0, 6.0)}
        answer = fem.deform(stack([lying[time] for time in (0.0, 1.5, 3.0)]))
        moved = 1e3 * np.linalg.norm(answer.displacement, axis=2)
        shift, tumour = moved[:, cortex].mean(axis=1), moved[:, anatomy.tumour_nodes].mean(axis=1)
        assert all(outcome.good for outcome in answer.outcome) and not answer.displacement[0].any()
        assert (np.diff(shift) > 0.3).all() and 5.0 < shift[2] < 8.0
        assert 1.2 < shift[2] / tumour[2] < 1.8
        # It sinks along gravity where it can, and turns with the head.
        turned = fem.deform(lying[6.0], answer.select(np.array([2])))
        way = [each.displacement[-1, cortex].mean(axis=0) for each in (answer, turned)]
        assert turned.outcome[0].good and way[0][1] < -0.8 * np.linalg.norm(way[0])
        assert way[1][0] < way[0][0] - 5e-4

    def test_cortex_sliding_below_the_bone_is_hidden_by_the_bone(self):
        theatre, scene = template_theatre(), small("brain_shift")
        site, held = theatre.site, replace(scene, effects=(Elasticity(), Held()))
        moved = theatre.anatomy.mesh.nodes + 8e-3 * site.right
        drawn, true = (Stage(each, site).build_visible_cortex(moved).vertices for each in (scene, held))
        beyond = site.compute_axis_distance(true) - HOLE_RATIO * site.clearance
        low = (drawn - true) @ site.axis
        assert (low[beyond < 0.0] == 0.0).all() and (low[beyond > 2e-3] > 5e-3).all() and (beyond > 2e-3).sum() > 20

    def test_border_of_the_visible_cortex_stays_below_the_bone(self, coarse):
        """Cortex that slides out from below the bone is drawn too: no gap at the rim of the hole."""
        playing = coarse.build_player("fem", small("brain_shift"))
        still, sunk = (playing.draw(0, time, Touch()) for time in (0.0, 3.0))
        seen = still.picture.segmentation == CORTEX
        inside = seen & ~(sunk.picture.segmentation == CORTEX)
        assert seen.sum() > 5000 and inside.sum() < 0.005 * seen.sum()  # without what lies under the bone: 0.012
