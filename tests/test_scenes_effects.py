"""What acts in a scene follows from its effects, and a learnt model answers none that it was not trained on."""

from __future__ import annotations

import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
from theatres import coarse_brain, player, short, sinking, small, template_theatre
from visitor import Visitor, free_port, wait_for

from scenes.builtin.retract import RELAXING
from scenes.episodes.episode import UNITS, collect
from scenes.page.demo import Demo
from scenes.play.checks import measure
from scenes.play.deformers import Theatre
from scenes.play.effect_ablation import without
from scenes.play.label import labelled
from scenes.play.load_text import acting
from scenes.play.reference import truth_of
from scenes.play.stage import CORTEX, TOOL, Stage
from scenes.script.head_posture import SUPINE, Lying, drained_then_turned, supine
from scenes.script.scene import Bounds, find_scene
from scenes.script.site import HOLE
from scenes.script.tool_paths import Touch
from sim.accuracy import LIVE, TRAIN
from sim.deformation import guess
from sim.effects import Elasticity, Gravity, Held, NodalForce, Slide, ToolForce
from sim.errors import InputError
from sim.loads import Loads, Posture, Pushed, posture, stacked
from sim.material import Material, tissue_to_json
from surrogate.model.applicability import refusal, trained_effects

EFFECTS = (Elasticity(), Held(), Slide())
STILL = guess(np.zeros((1, 3, 3)))


@pytest.fixture(scope="module")
def frames(theatre):
    return list(player(theatre, sinking(), "fem").frames(3))


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
    def test_they_follow_from_the_effects(self, theatre, effects, causes):
        loads = replace(short(), effects=effects).loads(theatre.site, Touch(force=0.2), 0.5)
        assert [type(cause) for cause in loads.causes] == causes and loads.times.tolist() == [0.5]

    def test_a_force_without_a_tool_is_refused(self):
        with pytest.raises(InputError, match="has no tool"):
            replace(short(), tool=None)

    def test_they_are_reported_in_words(self, theatre):
        both = replace(short(), effects=(*EFFECTS, Gravity(), ToolForce()))
        height = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.04]])  # from -32 to 0 mm against gravity
        words = acting(both.loads(theatre.site, Touch(force=0.2), 0.0), STILL, theatre.site.anatomy.mesh.nodes)
        assert "force 0.20 N" in words and "gravity pulls to the back, fluid up to" in words
        idle = acting(both.loads(theatre.site, Touch(force=0.0), 0.0), STILL, theatre.site.anatomy.mesh.nodes)
        assert "the tool does not push" in idle and "force" not in idle
        assert acting(Loads((), np.zeros(1)), STILL, height) == ""
        lying = posture(np.array([-3.0, 0.0, 4.0]), -0.012)
        way = "gravity pulls to the crown (0.80) and the left (0.60), fluid up to "
        assert acting(lying, STILL, height) == way + "62 % of the brain's height"


class TestLying:
    def test_the_fluid_falls_wholly_and_then_the_head_turns(self):
        lie, angle = drained_then_turned(2.0, 1.0, 3.0, 0.5), 0.5
        assert lie(0.0) == Lying(SUPINE, 1.0) == supine(7.0)
        assert lie(2.0) == Lying(SUPINE, 0.0) == lie(3.0) and 0.4 < lie(1.0).fluid < 0.6
        for time in (6.0, 9.0):
            assert lie(time).direction == pytest.approx((-np.sin(angle), -np.cos(angle), 0.0))
        levels = [lie(time).fluid for time in np.linspace(0.0, 2.0, 50)]
        assert (np.diff(levels) < 0.0).all()

    @pytest.mark.parametrize("direction", [SUPINE, (0.0, 0.0, -3.0), (-1.0, -1.0, 0.2)])
    def test_a_full_head_is_wet_and_a_drained_one_dry(self, box, direction):
        nodes = box.mesh.nodes
        for fluid, wet in ((1.0, len(nodes)), (0.0, 0)):
            found = Lying(direction, fluid).posture(nodes)
            assert np.linalg.norm(found.direction) == pytest.approx(1.0)
            assert (-nodes @ found.direction[0] < found.csf_level[0]).sum() == wet

    def test_a_head_that_lies_as_in_the_scan_is_at_rest(self, theatre):
        frame = player(theatre, sinking(), "fem").draw(0, 0.0, Touch())
        assert not frame.deformation.displacement.any()


class TestLearnt:
    def test_it_refuses_effects_that_it_was_not_trained_on(self, theatre):
        model = theatre.models["linear"]
        assert refusal(model, short().effects) is None
        why = refusal(model, (*short().effects, Gravity()))
        assert why is not None and "not under Gravity" in why
        with pytest.raises(InputError, match=r"svr does not know the scene sinking.*but Gravity. Choose one of fem"):
            theatre.player("svr", sinking())
        # No force at all: it has nothing to say of that either.
        assert "here is none" in (refusal(model, EFFECTS) or "") and theatre.names(
            replace(short(), effects=EFFECTS)
        ) == ("fem",)
        assert theatre.names(short()) == ("linear", "svr", "guarded", "fem") and theatre.names(sinking()) == ("fem",)
        assert theatre.best(sinking()) == "fem"

    def test_it_refuses_causes_that_it_does_not_know(self, theatre):
        model, scene = theatre.models["linear"], sinking()
        with pytest.raises(InputError, match="causes Posture"):
            model.deform(scene.loads(theatre.site, Touch(), 0.0))
        with pytest.raises(InputError, match="causes none"):
            model.deform(Loads((), np.zeros(2)))

    def test_its_file_says_what_it_was_trained_under(self, theatre):
        model = theatre.models["linear"]
        assert trained_effects(model.training) == {"Elasticity", "Held", "Slide", "ToolForce"}  # its file does not say
        effects = (Elasticity(regions={2: Elasticity().default}), Held(), ToolForce(), NodalForce())  # type: ignore
        stated = replace(model, training={"effects": repr(effects)})
        assert trained_effects(stated.training) == {"Elasticity", "Held", "ToolForce", "NodalForce"}
        # Nothing slides in this body, and nodal forces act where loads hold some.
        assert refusal(stated, short().effects) is None
        why = refusal(stated, (Elasticity(), ToolForce()))
        assert why is not None and "never without Held" in why

    def test_where_the_skull_slides_it_matters(self, theatre, box):
        normal = np.zeros_like(box.slide_normal)
        normal[0, 0] = 1.0
        model = replace(theatre.models["linear"], anatomy=replace(box, slide_normal=normal))
        why = refusal(model, (Elasticity(), Held(), ToolForce()))
        assert why is not None and "never without Slide" in why

    def test_models_beside_an_anatomy_do_not_change_its_physics(self, theatre):
        training = {"element": "p1", "tissue": tissue_to_json(Material("neo-hookean", 9000.0, 0.3))}
        other = replace(theatre, models={"linear": replace(theatre.models["linear"], training=training)})
        assert other.fem(short(), LIVE).description == "finite elements (smoothed; neo-hookean, E 3 kPa, nu 0.49)"
        for scene in (short(), sinking()):
            found, alone = (each.fem(scene, LIVE) for each in (other, replace(theatre, models={})))
            assert (found.space.element, found.effects) == (alone.space.element, alone.effects)

    @pytest.mark.parametrize(
        ("training", "reason"),
        [
            ({"element": "p1"}, "learned from p1 elements, and here they are smoothed"),
            ({"tissue": tissue_to_json(Material("neo-hookean", 9000.0, 0.3))}, "E 9 kPa, nu 0.3, and here it is .*E 3"),
        ],
    )
    def test_a_model_of_another_body_is_refused(self, theatre, training, reason):
        model = replace(theatre.models["linear"], training=training)
        other = replace(theatre, models={"linear": model})
        assert other.names(short()) == ("fem",)
        with pytest.raises(InputError, match=reason):
            other.deformer("linear", short())
        tissue, element = (Material("neo-hookean", 9000.0, 0.3), None) if "tissue" in training else (None, "p1")
        assert other.deformer("linear", short().made_of(tissue, element)) is model

    def test_another_tissue_goes_on_relaxing(self):
        scene = find_scene("retract").made_of(Material("neo-hookean", 9000.0, 0.3), "p2")
        (effect,) = (each for each in scene.effects if isinstance(each, Elasticity))
        assert scene.element == "p2" and effect.default == Material("neo-hookean", 9000.0, 0.3, RELAXING.prony)
        with pytest.raises(InputError, match="cannot relax"):
            find_scene("retract").made_of(Material("linear", 9000.0, 0.3), None)


class TestWithoutATool:
    def test_none_is_drawn_or_measured(self, frames, monkeypatch):
        for frame in frames:
            assert frame.pose is frame.tip is frame.distance is None
            assert not (frame.picture.segmentation == TOOL).any()
            assert (frame.shown != frame.picture.colour).any()
        lines = []
        monkeypatch.setattr("scenes.play.label.panel", lambda colour, text, **given: lines.extend(text) or colour)
        labelled(frames[-1], "fem")
        assert any(
            re.search(r"to the left \(0.87\) and the back \(0.50\), fluid up to \d+ % of the brain's height", line)
            for line in lines
        )
        assert not any("0.00 N" in line for line in lines)

    def test_it_can_be_checked(self, theatre, frames):
        play = player(theatre, sinking(), "fem")
        figures = measure(
            play, play.camera_at, frames, truth_of(theatre, play.scene, [frame.loads for frame in frames])
        )
        assert not figures.broken(Bounds()) and figures.motion_mm > 0.01

    def test_its_episode_tells_the_posture(self, theatre, tmp_path):
        collect(tmp_path / "a.h5", theatre, player(theatre, sinking(), "fem"), "fem", iter)
        with h5py.File(tmp_path / "a.h5") as file:
            assert not {"force", "contact", "tip", "T_world_tool"} & set(file)
            assert file["direction"].shape == (7, 3) and file["csf_level"].shape == (7,)
            assert file["csf_level"].attrs["unit"] == UNITS["csf_level"] == "m"
            assert np.diff(file["csf_level"][:4]).max() < 0.0

    def test_the_page_offers_no_hand(self, theatre):
        demo = Demo(theatre, sinking(), "fem", "127.0.0.1", free_port())
        try:
            assert (
                set(demo.browser.inputs) == {"scene", "deformer", "overlay", "camera", "Gravity"}
                and "tool" not in demo.browser.meshes
            )
            assert wait_for(lambda: demo.run(0.3) and "gravity pulls" in demo.browser.shown[2])
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

    def test_effects_go_off_and_on_and_the_change_is_reported(self, demo, theatre):
        page, visitor = demo.browser, Visitor(demo.browser, 1200)
        assert {"ToolForce", "Gravity"} < set(page.inputs) and not {"Held", "Elasticity"} & set(page.inputs)
        assert wait_for(lambda: demo.run(0.3) and "finite elements' own answer" in page.shown[2])
        visitor.set(page.inputs["Gravity"], False)
        assert wait_for(lambda: demo.run(0.3) and "without gravity and fluid the tumour is" in page.shown[2])
        said = float(page.shown[2].split("the tumour is ")[1].split(" mm")[0])
        scene, nodes = demo.stage.scene, theatre.anatomy.tumour_nodes
        plain, less = replace(theatre, models={}), without(scene, Gravity())
        one, other = (
            plain.fem(each, TRAIN).deform(each.loads(theatre.site, each.path(5 / 30), 5 / 30)).at(nodes).displacement[0]
            for each in (scene, less)
        )
        change = 1e3 * np.linalg.norm(one - other, axis=1).mean()
        assert change > 0.1 and said == pytest.approx(change, abs=0.02)
        assert "gravity pulls" not in page.shown[2]
        visitor.set(page.inputs["Gravity"], True)
        assert wait_for(lambda: demo.run(0.3) and "finite elements' own answer" in page.shown[2])
        visitor.wire.close()

    def test_without_any_nothing_moves(self, demo):
        demo.wish.switch("Gravity", False)
        demo.wish.switch("ToolForce", False)
        assert wait_for(
            lambda: demo.run(0.3) and "without gravity and fluid, push of the tool the" in demo.browser.shown[2]
        )
        assert "Nothing moves the tumour" in demo.browser.shown[2]
        demo.wish.switch("Gravity", True)
        assert demo.wish.off == {"ToolForce"}


@pytest.fixture(scope="module")
def coarse():
    """The brain that ships, on fewer nodes."""
    return Theatre(coarse_brain(), None, {}, "cpu")


class TestBrainShift:
    def test_the_brain_sinks_as_far_as_in_patients(self, coarse):
        """Cortex 6.1 +- 3.4 mm in 61 patients; 5.1, and the tumour 3.5, over 1,000 computed cases."""
        theatre, anatomy, scene = coarse, coarse.anatomy, find_scene("brain_shift")
        fem, cortex = theatre.fem(scene, scene.accuracy), np.unique(anatomy.open_surface)
        lying = {time: scene.loads(theatre.site, scene.path(time), time) for time in (0.0, 1.5, 3.0, 6.0)}
        answer = fem.deform(stacked([lying[time] for time in (0.0, 1.5, 3.0)]))
        moved = 1e3 * np.linalg.norm(answer.displacement, axis=2)
        shift, tumour = moved[:, cortex].mean(axis=1), moved[:, anatomy.tumour_nodes].mean(axis=1)
        assert all(outcome.good for outcome in answer.outcome) and not answer.displacement[0].any()
        assert (np.diff(shift) > 0.3).all() and 5.0 < shift[2] < 8.0
        assert 1.2 < shift[2] / tumour[2] < 1.8
        # It sinks along gravity where it can, and turns with the head.
        turned = fem.deform(lying[6.0], answer.rows(np.array([2])))
        way = [each.displacement[-1, cortex].mean(axis=0) for each in (answer, turned)]
        assert turned.outcome[0].good and way[0][1] < -0.8 * np.linalg.norm(way[0])
        assert way[1][0] < way[0][0] - 5e-4

    def test_cortex_that_slides_under_the_bone_is_not_drawn_above_it(self):
        theatre, scene = template_theatre(), small("brain_shift")
        site, held = theatre.site, replace(scene, effects=(Elasticity(), Held()))
        moved = theatre.anatomy.mesh.nodes + 8e-3 * site.right
        drawn, true = (Stage(each, site).visible(moved).vertices for each in (scene, held))
        beyond = site.across(true) - HOLE * site.clearance
        low = (drawn - true) @ site.axis
        assert (low[beyond < 0.0] == 0.0).all() and (low[beyond > 2e-3] > 5e-3).all() and (beyond > 2e-3).sum() > 20

    def test_its_border_stays_hidden(self, coarse):
        """The cortex that moves out from under the bone is drawn too: nothing is seen through the hole beside it."""
        playing = coarse.player("fem", small("brain_shift"))
        still, sunk = (playing.draw(0, time, Touch()) for time in (0.0, 3.0))
        seen = still.picture.segmentation == CORTEX
        inside = seen & ~(sunk.picture.segmentation == CORTEX)
        assert seen.sum() > 5000 and inside.sum() < 0.005 * seen.sum()  # without what lies under the bone: 0.012
