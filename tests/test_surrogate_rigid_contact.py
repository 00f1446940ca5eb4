"""Rods and blades moved by pose: draws, contact and trained models."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.cli import main
from scenes.script.scene import find_scene
from sim.accuracy import REFERENCE
from sim.anatomy import Anatomy
from sim.bodies.meshfile import write_anatomy
from sim.deformation import Deformation, Outcome
from sim.effects import Elasticity, Held, Retraction, ToolContact, build_push_effects
from sim.fem import Fem
from sim.loads import Loads, Retracted, Touching
from sim.material import BRAIN, Material, to_tissue_json
from sim.tools import Ball, BuiltIn, Capsule, Spatula, compute_distances, get_core
from surrogate.data.cortex_patch import build_barycentric_lattice, open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import Basis, compute_core_features, compute_tool_features
from surrogate.data.indentation import IndentationPushes, get_poses, to_indentation
from surrogate.data.simulate import simulate
from surrogate.data.tool_poses import ToolPoseSettings, draw_poses
from surrogate.evaluation.score import compute_point_errors
from surrogate.model.applicability import find_rejection
from surrogate.model.store import load, save
from surrogate.model.tool_contact import compute_wrench
from surrogate.regressors.rigid_contact import MEAN_GAP, RigidContact
from surrogate.training.fem_tables import condense_contact
from surrogate.training.train import train

ROD_OF_4 = Capsule(2e-3, 0.02)
SMALL_BLADE = Spatula(8e-3, 12e-3, 1.5e-3)
TOOLS = {"dissector": ROD_OF_4, "spatula": SMALL_BLADE}
SOFT = Material("linear", 3000.0, 0.45)


def condensed_box(box: Anatomy, tool: BuiltIn | None) -> tuple[RigidContact, list[Basis]]:
    fem = Fem(box, build_push_effects(box, SOFT), REFERENCE, "cpu", element="p1")
    return condense_contact(fem, [box.tumour_nodes, np.setdiff1d(open_patch(box).nodes, box.tumour_nodes)], tool)


def asked(box: Anatomy, loads: Loads, tool: BuiltIn) -> IndentationPushes:
    found = to_indentation(loads, tool, open_patch(box))
    assert isinstance(found, IndentationPushes)
    return found


def upright(box: Anatomy, tool: BuiltIn, depth: float) -> Loads:
    """Over the middle of the box's flat top, straight down."""
    points = open_patch(box).points
    pose = np.eye(4)
    pose[:3, 3] = 0.5 * (points.min(axis=0) + points.max(axis=0)) - [1e-4, 2e-4, depth]
    return Loads((Touching(pose[None, None]),))


@pytest.mark.parametrize("preset", TOOLS)
def test_drawn_poses_penetrate_from_first_contact(box, preset):
    tool, patch = TOOLS[preset], open_patch(box)
    loads = draw_poses(preset, box, 40, 3, tool)
    pose = get_poses(loads, tool)
    few = get_poses(draw_poses(preset, box, 9, 3, tool), tool)
    np.testing.assert_allclose(few, pose[:9], atol=1e-12)
    assert not np.allclose(get_poses(draw_poses(preset, box, 9, 4, tool), tool), pose[:9])
    known = ToolPoseSettings()
    rod, blade = known.max_rod_depth * ROD_OF_4.radius, known.max_blade_depth * SMALL_BLADE.width
    deepest = rod if isinstance(tool, Capsule) else blade
    surface = np.einsum("qc,scx->sqx", build_barycentric_lattice(4), patch.points[patch.triangles]).reshape(-1, 3)
    back = np.arange(0.0, 2.0 * deepest, 2e-5)
    for each in pose:
        way = np.tile(each, (len(back), 1, 1))
        way[:, :3, 3] += back[:, None] * each[:3, 2]
        touches = [bool(compute_distances(tool, one, surface).min() < 0.0) for one in way]
        depth = back[np.flatnonzero(touches)[-1]]
        assert known.min_depth_ratio * get_core(tool).radius - 4e-5 < depth < deepest + 4e-5
        cosine = -patch.find_normals(each[None, :3, 3])[0] @ each[:3, 2]
        assert cosine >= np.cos(known.max_blade_tilt if isinstance(tool, Spatula) else np.pi / 4.0) - 1e-9


def test_upright_rod_equals_the_ball_at_its_end(box):
    """Without contact of its side: equal indentation and forces, independent of rotation."""
    loads, ball = upright(box, ROD_OF_4, 1.2e-3), Ball(ROD_OF_4.radius)
    rod, round_ = asked(box, loads, ROD_OF_4), to_indentation(loads, ball, open_patch(box))
    for name in ("point", "force", "footprint"):
        np.testing.assert_allclose(getattr(rod, name), getattr(round_, name), atol=1e-9)
    patch = open_patch(box)
    force = condensed_box(box, ROD_OF_4)[0].compute_nodal_forces(compute_core_features(patch, rod))
    alike = condensed_box(box, ball)[0].compute_nodal_forces(compute_tool_features(patch, round_))
    np.testing.assert_allclose(force, alike, atol=0.02 * np.abs(alike).max())
    turned = loads.get(Touching)
    assert turned is not None
    pose = turned.pose.copy()
    pose[0, 0, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_array_equal(asked(box, Loads((Touching(pose),)), ROD_OF_4).axes, rod.axes)


def test_retracted_blade_uses_its_final_pose(box):
    """`Retracted` loads equal their final pose; a blade rotated by half a turn has the same features."""
    there = upright(box, SMALL_BLADE, 2e-3)
    pose = get_poses(there, SMALL_BLADE)
    above = pose.copy()
    above[:, :3, 3] -= [1e-3, 0.0, -9e-3]
    moved = Loads((Retracted(above, np.array([[1e-3, 0.0, -9e-3]])),))
    one, other = asked(box, there, SMALL_BLADE), asked(box, moved, SMALL_BLADE)
    np.testing.assert_allclose(
        compute_core_features(open_patch(box), one), compute_core_features(open_patch(box), other), atol=1e-12
    )
    turned = pose.copy()
    turned[:, :3, :2] *= -1.0
    back = asked(box, Loads((Touching(turned[:, None]),)), SMALL_BLADE)
    np.testing.assert_allclose(
        compute_tool_features(open_patch(box), back), compute_tool_features(open_patch(box), one), atol=1e-12
    )
    with pytest.raises(TypeError, match="only rods and blades"):
        compute_core_features(
            open_patch(box), to_indentation(upright(box, Ball(5e-3), 1e-3), Ball(5e-3), open_patch(box))
        )


@pytest.mark.parametrize("preset", TOOLS)
def test_rigid_contact_enters_no_facet_and_matches_fem(box, preset):
    """Signorini's conditions on a dense lattice of every facet, and the finite elements with a barrier."""
    tool, patch = TOOLS[preset], open_patch(box)
    contact, bases = condensed_box(box, tool)
    loads = draw_poses(preset, box, 5, 5, tool)
    X = compute_core_features(patch, asked(box, loads, tool))
    force = contact.compute_nodal_forces(X)
    moved = contact.points + (force @ contact.compliance.astype(np.float64).T).reshape(len(X), -1, 3)
    for row, pose in enumerate(get_poses(loads, tool)):
        facets = np.einsum("qc,sci->sqi", build_barycentric_lattice(12), moved[row][contact.triangles]).reshape(-1, 3)
        nearest = compute_distances(tool, pose, facets).min()
        assert MEAN_GAP - 3e-5 < nearest < MEAN_GAP + 1e-4
    fem = Fem(box, [Elasticity(SOFT), Held(), ToolContact((tool,))], device="cpu", batch=1, element="p1")
    truth = fem.deform(loads)
    assert all(outcome.good for outcome in truth.outcome)
    found = bases[0].decode((contact.predict(X) * X[:, 6:7])[:, : len(bases[0].modes)])
    theirs = truth.restrict(box.tumour_nodes).displacement
    off = np.linalg.norm(found - theirs, axis=(1, 2)) / np.linalg.norm(theirs, axis=(1, 2))
    assert off.mean() < 0.05 and off.max() < 0.1
    bears, reads = force.reshape(len(X), -1, 3).sum(axis=1), truth.reaction[:, 0, :3]
    assert (np.linalg.norm(bears - reads, axis=1) < 0.15 * np.linalg.norm(reads, axis=1)).all()


class Stiffening:
    """Answers poses of the rod as on linear tissue, whose forces grow with depth."""

    def __init__(self, anatomy: Anatomy):
        self.anatomy = anatomy
        self.contact, self.bases = condensed_box(anatomy, ROD_OF_4)

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        X = compute_core_features(open_patch(self.anatomy), asked(self.anatomy, loads, ROD_OF_4))
        grown = 1.0 + 0.2 * X[:, 6:7] / X[:, 7:8]
        answered = self.contact.compute_linear(X) * X[:, 6:7] * grown
        split, displacement = len(self.bases[0].modes), np.zeros((len(loads), len(self.anatomy.mesh.nodes), 3))
        for basis, coefficients in zip(self.bases, (answered[:, :split], answered[:, split:]), strict=True):
            displacement[:, basis.nodes] = basis.decode(coefficients)
        force = self.contact.compute_nodal_forces(X).reshape(len(loads), -1, 3).sum(axis=1) * grown
        nodes, count = np.arange(len(self.anatomy.mesh.nodes)), len(loads)
        reaction = np.nan_to_num(compute_wrench(force, get_poses(loads, ROD_OF_4), ROD_OF_4))
        outcome = (Outcome.CONVERGED,) * count
        answer = Deformation(displacement, nodes, outcome, np.zeros(count, int), np.zeros(count), loads.times, reaction)
        return answer if at is None else answer.restrict(at)


@pytest.fixture(scope="module")
def elements(box):
    return Stiffening(box)


@pytest.fixture(scope="module")
def data(tmp_path_factory, elements):
    path = tmp_path_factory.mktemp("rod") / "data.h5"
    effects = repr((Elasticity(), Held(), ToolContact((ROD_OF_4,))))
    said = {"shape": repr(ROD_OF_4), "tissue": to_tissue_json(SOFT), "effects": effects, "element": "p1"}
    simulate(path, elements, draw_poses("dissector", elements.anatomy, 80, 0, ROD_OF_4), said)
    return read_dataset(path)


@pytest.fixture(scope="module")
def model(data):
    return train(data, ["contact"]).models["contact"]


def test_rod_model_reaches_error_limit_and_round_trips(tmp_path, data, model, elements, box):
    assert data.tool == model.tool == ROD_OF_4
    fresh, nodes = draw_poses("dissector", box, 30, 77, ROD_OF_4), box.tumour_nodes
    truth, found = elements.deform(fresh), model.deform(fresh)
    moved = truth.restrict(nodes).displacement
    assert compute_point_errors(model, fresh, moved, nodes).mean() < 0.01 * np.linalg.norm(moved, axis=2).mean()
    size = np.linalg.norm(truth.reaction[:, 0, :3], axis=1)
    assert (np.linalg.norm((found.reaction - truth.reaction)[:, 0, :3], axis=1) < 0.02 * size).all()
    assert np.isnan(found.reaction[:, 0, 3:]).all()  # of a rod's moment a model knows nothing
    save(tmp_path / "model.npz", {"contact": model})
    again = load(tmp_path / "model.npz", box)["contact"]
    assert again.tool == ROD_OF_4
    np.testing.assert_array_equal(again.deform(fresh).displacement, found.displacement)


def test_rod_tilted_beyond_training_is_extrapolated(model, box):
    pose = get_poses(upright(box, ROD_OF_4, 1e-3), ROD_OF_4)
    angle = np.radians(70.0)
    pose[0, :3, :3] = [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    assert model.deform(upright(box, ROD_OF_4, 1e-3)).outcome == (Outcome.PREDICTED,)
    assert model.deform(Loads((Touching(pose[:, None]),))).outcome == (Outcome.EXTRAPOLATED,)


def test_blade_model_supports_retraction_but_no_relaxation(model):
    blade = SMALL_BLADE
    tissue = to_tissue_json(BRAIN)
    effects = (Elasticity(), Held(), ToolContact((blade,)))
    known = replace(model, tool=blade, training={"effects": repr(effects), "tissue": tissue})
    laid = (Elasticity(), Held(), Retraction(blade))
    assert find_rejection(known, laid) is None
    other = str(find_rejection(known, (Elasticity(), Held(), Retraction(Spatula(9e-3, 12e-3, 1e-3)))))
    assert "a blade of 8 x 12 mm, its edge of 1.5 mm, and here is a blade of 9 x 12 mm, its edge of 1 mm" in other
    relaxing = find_scene("retract").effects[0]
    words = "it learned from tissue that does not relax, and here it relaxes by 45 % in 0.5 s and 36.5 % in 50 s"
    assert find_rejection(known, (relaxing, Held(), Retraction(blade))) == words


def test_simulate_command_supports_rod_and_checks_tool_sizes(tmp_path, box, capsys):
    mesh, out = tmp_path / "box.vtu", tmp_path / "data.h5"
    write_anatomy(mesh, box)
    wanted = f"simulate {mesh} --out {out} --count 2 --tool-preset dissector --pose-control --json".split()
    assert main([*wanted, "--capsule", "2", "20"]) == 0
    found = read_dataset(out)
    assert found.tool == ROD_OF_4 and found.good.all()
    for sizes in (["--blade", "8", "12", "-1.5"], ["--capsule", "0.004", "0.02"], ["--ball", "700"]):
        assert main([*wanted, *sizes, "--force"]) == 2
        assert f"{' '.join(sizes)}: sizes are in millimetres: give 0.1 to 200 each" in capsys.readouterr().err
