"""Palpation scenes with manual control: tool force, models, and reproducible solutions."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from theatres import player

from scenes.episodes.episode import collect
from scenes.play.frame_text import format_active_loads
from scenes.play.player import Player
from scenes.script.scene import Scene, Viewpoint, find_scene
from scenes.script.tool_paths import IDLE_HEIGHT, Touch
from sim.accuracy import REFERENCE
from sim.anatomy import Anatomy
from sim.deformation import Outcome
from sim.effects import Elasticity, Held, Slide, ToolContact
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Touching, stack
from sim.material import Material
from sim.tools import Ball, compute_distances
from surrogate.data.cortex_patch import open_patch
from surrogate.model.applicability import find_rejection
from surrogate.model.guarded import find_first_model
from surrogate.model.learned import Learned, ModelPart
from surrogate.model.tool_contact import ForceModel
from surrogate.model.training_range import TrainingRange
from surrogate.training.fem_tables import condense_contact, join_bases

NODES = np.zeros((1, 3))
SMALL = Viewpoint(width=160, height=120)


def small(name: str) -> Scene:
    """A built-in scene with a small picture and linear elements."""
    return replace(find_scene(name), viewpoint=SMALL, element=None)


@pytest.fixture(scope="module")
def palpated(theatre):
    return list(player(theatre, small("palpate"), "fem").play_frames(10))


def untrained(anatomy: Anatomy, scene: Scene) -> Learned:
    """What linear tissue says to the poses of a scene's ball, as a model that takes any of them."""
    (ball,) = (tool for effect in scene.effects if isinstance(effect, ToolContact) for tool in effect.tools)
    assert isinstance(ball, Ball)
    patch = open_patch(anatomy)
    fem = Fem(anatomy, (Elasticity(Material("linear", 5000.0, 0.49)), Held(), Slide()), REFERENCE, "cpu")
    contact, bases = condense_contact(fem, [anatomy.tumour_nodes, np.setdiff1d(patch.nodes, anatomy.tumour_nodes)])
    envelope = TrainingRange(patch.points, 1.0, 1.0, np.pi, (1e-6, 1.0), (ball.radius, ball.radius), np.inf)
    said = {"effects": repr(scene.effects)}
    parts = (ModelPart("tool", replace(contact, grip=np.array([1.0, 0.0])), join_bases(bases)),)
    return Learned(anatomy, parts, envelope, training=said, tool=ball, force=ForceModel())


class TestPalpate:
    def test_tool_force_is_positive_only_during_contact(self, palpated):
        reads = np.array([-frame.deformation.reaction[0, 0, 2] for frame in palpated])
        depth = np.array([frame.touch.depth for frame in palpated])
        assert all(frame.deformation.outcome[0].good for frame in palpated)
        assert (reads[depth > 2e-3] > 0.02).all() and (reads[depth < -2e-3] == 0.0).all()
        assert depth.min() == -IDLE_HEIGHT and depth.max() == pytest.approx(4e-3)

    def test_no_vertex_is_inside_the_drawn_tool(self, theatre, palpated):
        shape = find_scene("palpate").tool.shape
        for frame in palpated:
            (cause,) = frame.loads.causes
            assert isinstance(cause, Touching)
            np.testing.assert_array_equal(cause.pose[0, 0], frame.pose)
            positions = theatre.anatomy.mesh.nodes + frame.deformation.displacement[0]
            assert compute_distances(shape, frame.pose, positions).min() > 0.0

    def test_frame_solved_again_from_same_start_is_identical(self, theatre, palpated):
        """Frames depend on their loads and on their start solution alone."""
        again = player(theatre, small("palpate"), "fem")
        for row in (8, 3, 6):
            frame = palpated[row]
            drawn = again.draw(frame.number, frame.time, frame.touch, palpated[row - 1].deformation)
            np.testing.assert_array_equal(drawn.deformation.displacement, frame.deformation.displacement)

    def test_page_text_has_the_tool_force(self, palpated):
        frame = palpated[6]
        reads = np.linalg.norm(frame.deformation.reaction[0, 0, :3])
        assert frame.acts == f"tool force {reads:.2f} N"

    def test_model_without_force_output_shows_no_tool_force(self, palpated):
        """The model is trained on tool positions and predicts no force."""
        frame = palpated[6]
        assert format_active_loads(frame.loads, replace(frame.deformation, reaction=np.zeros((1, 0, 6))), NODES) == ""

    def test_predicted_tool_force_is_shown_with_its_error_bound(self, palpated):
        frame = palpated[6]
        reads = np.linalg.norm(frame.deformation.reaction[0, 0, :3])
        answer = replace(frame.deformation, reaction_bound=np.array([[0.012], [0.02]]), outcome=(Outcome.PREDICTED,))
        assert format_active_loads(frame.loads, answer, NODES) == f"tool force {reads:.2f} +- 0.02 N (surrogate)"
        far = replace(answer, outcome=(Outcome.EXTRAPOLATED,))
        assert format_active_loads(frame.loads, far, NODES) == f"tool force {reads:.2f} N"

    @pytest.mark.parametrize("force", [ForceModel(), None])
    def test_guarded_deformer_uses_fem_beyond_training_depth(self, theatre, palpated, force):
        """For single frames and for one batch of all frames."""
        scene, anatomy = small("palpate"), theatre.anatomy
        plain = replace(untrained(anatomy, scene), bound=1e-4, force=force)
        model = replace(plain, envelope=replace(plain.envelope, force=(1e-6, 2e-3)))
        both = replace(theatre, models={"contact": model})
        assert both.list_deformers(scene) == ("contact", "guarded", "fem")
        play, by_model = player(both, scene, "guarded"), 0
        frames = list(play.play_frames(10))
        for frame, solved in zip(frames, palpated, strict=True):
            trained = find_first_model(play.deformer, frame.deformation) is not None
            by_model += trained
            assert trained == (model.deform(frame.loads).outcome[0] is Outcome.PREDICTED)
            expected = model.deform(frame.loads) if trained else solved.deformation
            nodes = anatomy.tumour_nodes
            theirs = expected.restrict(nodes).displacement
            assert frame.deformation.restrict(nodes).displacement == pytest.approx(theirs, abs=1e-5)
            if force is not None:
                assert frame.deformation.reaction == pytest.approx(expected.reaction, abs=2e-3)
        assert 2 < by_model < len(frames) - 2
        batch = play.deformer.deform(stack([frame.loads for frame in frames]), at=nodes)
        for row, (frame, solved) in enumerate(zip(frames, palpated, strict=True)):
            theirs = frame.deformation.restrict(nodes).displacement[0]
            assert batch.displacement[row] == pytest.approx(theirs, abs=1e-5)
            known = batch.outcome[row] is Outcome.PREDICTED
            assert np.isnan(batch.reaction_bound).all() and batch.reaction.shape == (len(frames), force is not None, 6)
            if force is not None and not known:
                assert batch.reaction[row] == pytest.approx(solved.deformation.reaction[0], abs=2e-3)

    def test_episode_stores_model_and_fem_force(self, theatre, tmp_path):
        scene = replace(small("palpate"), path=lambda time: Touch(depth=2e-3), duration=0.1)
        both = replace(theatre, models={"contact": untrained(theatre.anatomy, scene)})
        collect(tmp_path / "palpate.h5", both, player(both, scene, "contact"), "contact", iter)
        with h5py.File(tmp_path / "palpate.h5") as file:
            found, solved = file["reaction_predicted"], file["reaction_fem"][:]
            assert found.attrs["unit"] == "N, N m" and found.shape == solved.shape == (4, 1, 6)
            size = np.linalg.norm(solved[:, 0, :3], axis=1)
            along = np.einsum("fi,fi->f", found[:, 0, :3], solved[:, 0, :3])
            assert (along > 0.9 * size * np.linalg.norm(found[:, 0, :3], axis=1)).all()
            assert np.isnan(file["reaction_bound"][:]).all() and file["reaction_bound"].shape == (4, 2)

    def test_linear_contact_model_approximates_fem(self, theatre, palpated):
        """Against FEM of softer, stiffening tissue, on tumour and cortex."""
        scene, anatomy = small("palpate"), theatre.anatomy
        model = untrained(anatomy, scene)
        assert find_rejection(model, scene.effects) is None
        drawn = Player(player(theatre, scene, "fem").stage, model)
        pressed = [frame for frame in palpated if frame.touch.depth > 1e-3]
        assert len(pressed) > 3
        for frame in pressed:
            answer = drawn.draw(frame.number, frame.time, frame.touch).deformation
            for nodes, most in ((anatomy.tumour_nodes, 0.2), (open_patch(anatomy).nodes, 0.25)):
                theirs = frame.deformation.restrict(nodes).displacement
                off = np.linalg.norm(answer.restrict(nodes).displacement - theirs)
                assert off < most * np.linalg.norm(theirs)

    def test_push_models_are_rejected_for_palpation(self, theatre):
        with pytest.raises(InputError, match="palpate"):
            theatre.build_deformer("linear", small("palpate"))
        assert theatre.list_deformers(small("palpate")) == ("fem",)


def test_tool_contact_in_scene_without_tool_is_rejected():
    with pytest.raises(InputError, match="asks for ToolContact, but has no tool"):
        replace(find_scene("palpate"), tool=None)


def test_tool_above_the_cortex_deforms_no_tissue(theatre):
    scene = small("palpate")
    fem = theatre.build_fem(scene, scene.accuracy)
    loads = scene.build_loads(theatre.site, Touch(depth=-1e-3), 0.0)
    np.testing.assert_array_equal(fem.deform(loads).displacement, 0.0)
    assert Held() in fem.effects
