"""Models of tool poses: indentations, draws, training, storage and rejected input."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from scenes.cli import main
from scenes.script.shipped_files import get_template_path
from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.deformation import Deformation, Deformer, Outcome
from sim.effects import Elasticity, Held, NodalForce, ToolContact, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.tools import Ball, Capsule
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.indentation import to_indentation
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import TOOLS, draw
from surrogate.data.tool_poses import ToolPoseSettings, choose_ball, compute_poses, draw_poses
from surrogate.evaluation.score import compute_point_errors
from surrogate.model.applicability import find_rejection
from surrogate.model.learned import Learned
from surrogate.model.store import load, save
from surrogate.model.training_range import compute_training_range
from surrogate.training.learners import POSE_MODELS
from surrogate.training.train import list_learners, train

BALL = choose_ball("palpation")
EFFECTS = (Elasticity(), Held(), ToolContact((BALL,)))
SAID = {"shape": repr(BALL), "effects": repr(EFFECTS)}


def test_pose_draw_depends_only_on_seed_and_number(box):
    few, many = draw_poses("palpation", box, 10, 4), draw_poses("palpation", box, 30, 4)
    some, all_of = few.get(Touching), many.get(Touching)
    assert some is not None
    assert all_of is not None
    np.testing.assert_array_equal(some.pose, all_of.pose[:10])
    other = draw_poses("palpation", box, 10, 5).get(Touching)
    assert other is not None
    assert not np.array_equal(some.pose, other.pose)
    depth = np.linalg.norm(to_indentation(many, BALL, open_patch(box)).force, axis=1) / BALL.radius
    assert depth.min() >= ToolPoseSettings.min_depth_ratio * np.cos(TOOLS["palpation"].max_angle) - 1e-9
    assert depth.max() <= ToolPoseSettings.max_ball_depth + 1e-9


@dataclass(frozen=True)
class PosedPretender:
    """Answers poses as pushes whose force goes with depth to the power of 1.5."""

    pretender: Deformer

    @property
    def anatomy(self) -> Anatomy:
        return self.pretender.anatomy

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        pushed = to_indentation(loads, BALL, open_patch(self.anatomy))
        depth = np.linalg.norm(pushed.force, axis=1, keepdims=True)
        force = 400.0 * np.sqrt(BALL.radius) * np.sqrt(depth) * pushed.force
        return self.pretender.deform(Loads((replace(pushed, force=force),), loads.times), start, at)


@pytest.fixture(scope="module")
def data(tmp_path_factory, pretender):
    path = tmp_path_factory.mktemp("poses") / "data.h5"
    counted = simulate(path, PosedPretender(pretender), draw_poses("palpation", pretender.anatomy, 360, 0), SAID)
    assert (counted.load_count, counted.unit_count) == (360, 0)
    return read_dataset(path)


@pytest.fixture(scope="module")
def trained(data):
    return train(data, ["gp"])


def test_pose_models_train_without_reaction_forces(data, trained, pretender, box):
    """Errors of a few per cent on new poses, and bounds with about their nominal coverage."""
    assert list_learners(data) == POSE_MODELS
    model, fresh = trained.models["gp"], draw_poses("palpation", box, 100, 77)
    nodes = box.tumour_nodes
    truth = PosedPretender(pretender).deform(fresh).restrict(nodes).displacement
    error = compute_point_errors(model, fresh, truth, nodes)
    assert error.mean() < 0.05 * np.linalg.norm(truth, axis=2).mean()
    found = model.deform(fresh, at=nodes)
    assert found.outcome.count(Outcome.PREDICTED) > 90
    assert (error.max(axis=1) <= found.bound[0]).mean() > 0.85
    assert found.reaction.shape == (100, 0, 6)
    cortex = open_patch(box).nodes
    exact = PosedPretender(pretender).deform(fresh).restrict(cortex).displacement
    assert np.linalg.norm(model.deform(fresh, at=cortex).displacement - exact) < 0.2 * np.linalg.norm(exact)


def test_poses_outside_training_range_are_extrapolated(trained, box):
    model, patch = trained.models["gp"], open_patch(box)
    middle = patch.points.mean(axis=0, keepdims=True)
    way = patch.find_normals(middle)
    deep = Loads((compute_poses(BALL, middle, way, 1.2 * BALL.radius * way),))
    assert model.deform(deep).outcome == (Outcome.EXTRAPOLATED,)
    off = Loads((compute_poses(BALL, middle + [0.024, 0.0, 0.0], way, 2e-3 * way),))
    assert model.deform(off).outcome == (Outcome.EXTRAPOLATED,)
    air = Loads((compute_poses(BALL, middle - 0.02 * way, way, 2e-3 * way),))
    assert not model.deform(air).displacement.any()
    assert model.deform(air).outcome == (Outcome.PREDICTED,)


def test_stored_model_keeps_its_tool(tmp_path, trained, box):
    save(tmp_path / "model.npz", trained.models)
    again, fresh = load(tmp_path / "model.npz", box)["gp"], draw_poses("palpation", box, 5, 1)
    assert again.tool == BALL
    np.testing.assert_array_equal(again.deform(fresh).displacement, trained.models["gp"].deform(fresh).displacement)


def test_training_poses_are_identified_despite_shared_vertices():
    """Points that are no vertices of the cortex distinguish a test data set from the training set."""
    template = read_anatomy(get_template_path())
    patch, corners = open_patch(template), template.mesh.nodes
    first, same, other = (
        to_indentation(draw_poses("palpation", template, 900, seed), choose_ball("palpation"), patch)
        for seed in (0, 0, 1)
    )
    known = compute_training_range(patch, first)
    shared = (known.points[:, None] == other.point.astype(np.float32)).all(axis=2).any(axis=1)
    assert shared.sum() > 3 and not known.is_training_point(other.point, corners)
    assert known.is_training_point(same.point, corners)


def test_pose_and_force_models_reject_each_others_loads(trained, box):
    model = trained.models["gp"]
    with pytest.raises(InputError, match="causes Pushed, but this model was trained on the poses of a ball"):
        model.deform(draw("palpation", box, 2, 0))
    two = Touching(np.tile(np.eye(4), (1, 2, 1, 1)))
    with pytest.raises(InputError, match=r"poses of a ball of 6.25 mm"):
        model.deform(Loads((two,)))
    forces = Learned(box, model.parts, model.envelope)
    with pytest.raises(InputError, match="loads is None: give Loads"):
        forces.deform(None)
    with pytest.raises(InputError, match="trained on pushing forces only"):
        forces.deform(draw_poses("palpation", box, 2, 0))
    assert find_rejection(model, EFFECTS) is None
    for tools in ((Ball(5e-3),), (BALL, BALL), (Capsule(BALL.radius, 0.01),)):
        assert "and here is a " in str(find_rejection(model, (Elasticity(), Held(), ToolContact(tools))))
    assert "and here is none that is moved" in str(find_rejection(model, (Elasticity(), Held(), ToolForce())))
    assert "not under ToolForce" in str(find_rejection(model, (*EFFECTS, ToolForce())))
    assert "here is none, but ToolContact" in str(find_rejection(forces, EFFECTS))


def test_unsupported_pose_training_is_rejected(data, box):
    with pytest.raises(
        InputError, match="poses, of which linear, series cannot be had: choose from contact, contact-gp, gp"
    ):
        train(data, ["linear", "gp", "series"])
    with pytest.raises(InputError, match="no ball stands for the preset spatula: choose one of palpation"):
        draw_poses("spatula", box, 2, 0)
    with pytest.raises(InputError, match=r"Ball.radius is -0.001 m: give a positive number"):
        draw_poses("palpation", box, 2, 0, Ball(-1e-3))
    with pytest.raises(InputError, match="holds other loads than `Pushed`"):
        train(replace(data, provenance={}), ["gp"])


def test_simulate_command_solves_poses_with_fem(tmp_path, box, capsys):
    mesh, out = tmp_path / "box.vtu", tmp_path / "data.h5"
    write_anatomy(mesh, box)
    wanted = ["simulate", str(mesh), "--out", str(out), "--count", "3", "--json"]
    assert main([*wanted, "--ball", "7"]) == 2
    assert "--blade are moved by pose: give --pose-control too" in capsys.readouterr().err
    assert main([*wanted, "--poses", "--ball", "7"]) == 0
    ball = Ball(7e-3)
    data = read_dataset(out)
    assert data.good.all()
    assert data.tool == ball
    assert "NodalForce" not in data.provenance["effects"]
    fem = Fem(read_anatomy(mesh), (Elasticity(), Held(), ToolContact((ball,))), device="cpu", batch=1)
    truth = fem.deform(data.loads)
    stored = data.read_displacement(np.arange(len(box.mesh.nodes)))
    assert np.linalg.norm(stored - truth.displacement) < 1e-3 * np.linalg.norm(truth.displacement)
    reaction = data.read_reaction()
    assert reaction is not None
    np.testing.assert_allclose(reaction, truth.reaction, atol=2e-3 * np.abs(truth.reaction).max())
    force = truth.reaction[:, 0, :3]
    shaft = data.loads.get(Touching).pose[:, 0, :3, 2]  # pyright: ignore[reportOptionalMemberAccess]
    assert (np.einsum("bi,bi->b", force, shaft) < 0.0).all()
    assert NodalForce not in {type(effect) for effect in fem.effects}
