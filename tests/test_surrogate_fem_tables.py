"""Ball on condensed linear tissue: contact conditions, reference solutions and learned corrections."""

import shutil
from dataclasses import dataclass, replace

import h5py
import numpy as np
import pytest

from sim.accuracy import REFERENCE
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Outcome
from sim.effects import Elasticity, Held, NodalForce, ToolContact, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Nodal, Touching
from sim.material import Material, to_tissue_json
from surrogate.data.cortex_patch import build_barycentric_lattice, open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import Basis, compute_tool_features
from surrogate.data.indentation import get_poses, to_indentation
from surrogate.data.simulate import simulate
from surrogate.data.solution_rows import compute_row_checksums, get_row_dtype
from surrogate.data.tool_poses import choose_ball, compute_poses, draw_poses
from surrogate.evaluation.score import compare_forces, compute_point_errors
from surrogate.model.store import load, save
from surrogate.model.tool_contact import compute_wrench
from surrogate.regressors.rigid_contact import MEAN_GAP, RigidContact
from surrogate.training.expansion import CONTACT_MODELS
from surrogate.training.fem_tables import compute_unit_responses, condense_contact
from surrogate.training.train import list_learners, train

BALL = choose_ball("palpation")
SOFT = Material("linear", 3000.0, 0.45)
# What the pretender's forces do far away: at no depth, and more by so much a radius of depth.
LINE = (0.97, 0.3)
# The same of the force that the tool exerts.
GRIP = (1.05, 0.5)


def features(anatomy: Anatomy, loads: Loads) -> np.ndarray:
    patch = open_patch(anatomy)
    return compute_tool_features(patch, to_indentation(loads, BALL, patch))


def bodily(anatomy: Anatomy, tissue: Material) -> Fem:
    return Fem(anatomy, build_push_effects(anatomy, tissue), REFERENCE, "cpu", element="p1")


@pytest.fixture(scope="module")
def pressed(box):
    return condense_contact(
        bodily(box, SOFT), [box.tumour_nodes, np.setdiff1d(open_patch(box).nodes, box.tumour_nodes)]
    )


def test_ball_contact_satisfies_signorini_conditions(box, pressed):
    """A dense lattice of every facet is outside the ball, which pushes and does not pull (Signorini's conditions).

    Contact forces act along lines through the centre, with no moment about it. Nodes far from the ball bear no
    force.
    """
    contact, loads = pressed[0], draw_poses("palpation", box, 30, 2)
    X = features(box, loads)
    force = contact.compute_nodal_forces(X)
    moved = contact.points + (force @ contact.compliance.astype(np.float64).T).reshape(len(X), -1, 3)
    middle = X[:, :3] + (X[:, 6] - X[:, 7])[:, None] * X[:, 3:6]
    arm, force = moved - middle[:, None], force.reshape(moved.shape)
    facets = np.einsum("qc,bsci->bsqi", build_barycentric_lattice(12), arm[:, contact.triangles])
    nearest = np.linalg.norm(facets, axis=3).min(axis=(1, 2))
    assert (nearest > BALL.radius + MEAN_GAP - 2e-6).all()
    assert (nearest < BALL.radius + MEAN_GAP + 1e-4).all()
    assert (np.einsum("bi,bi->b", force.sum(axis=1), X[:, 3:6]) > 0.0).all()
    moment = np.linalg.norm(np.cross(arm, force).sum(axis=1), axis=1)
    size = np.linalg.norm(force.sum(axis=1), axis=1) * BALL.radius
    assert (moment < 1e-3 * size).all()
    # What is far from the ball bears nothing.
    idle = np.linalg.norm(arm, axis=2) > BALL.radius + 9e-3
    assert not force[idle].any()


def test_ball_contact_matches_linear_finite_elements(box, pressed):
    """Same body with and without condensation, deep and oblique; the difference is the gap of the barrier."""
    contact, bases = pressed
    fem = Fem(box, [Elasticity(SOFT), Held(), ToolContact((BALL,))], device="cpu", batch=1, element="p1")
    loads, cortex = draw_poses("palpation", box, 8, 5), bases[1].nodes
    truth, X = fem.deform(loads), features(box, loads)
    assert all(outcome.good for outcome in truth.outcome)
    answered = contact.predict(X) * X[:, 6:7]
    split = len(bases[0].modes)
    found = bases[0].decode(answered[:, :split]), bases[1].decode(answered[:, split:])
    for nodes, ours in ((box.tumour_nodes, found[0]), (cortex, found[1])):
        theirs = truth.restrict(nodes).displacement
        off = np.linalg.norm(ours - theirs, axis=(1, 2)) / np.linalg.norm(theirs, axis=(1, 2))
        assert off.mean() < 0.03
        assert off.max() < 0.06
    bears = contact.compute_nodal_forces(X).reshape(len(X), -1, 3).sum(axis=1)
    reads = truth.reaction[:, 0, :3]
    assert (np.linalg.norm(bears - reads, axis=1) < 0.05 * np.linalg.norm(reads, axis=1)).all()


def test_bone_nodes_under_the_ball_give_bounded_force(box, pressed):
    """Over the rim the ball overlaps rigid bone: soft nodes are displaced, and forces stay bounded."""
    contact, rim = pressed[0], open_patch(box).points
    middle, pose = 0.5 * (rim.min(axis=0) + rim.max(axis=0)), np.tile(np.eye(4), (8, 1, 1, 1))
    pose[:, 0, :3, 3] = middle + np.linspace([0.0, 0.0, -4e-3], [1.25 * (rim[:, 0].max() - middle[0]), 0.0, -4e-3], 8)
    force = contact.compute_nodal_forces(features(box, Loads((Touching(pose),)))).reshape(8, -1, 3)
    stiff = np.einsum("nini->n", contact.compliance.reshape(force.shape[1], 3, -1, 3)) == 0.0
    assert stiff.any() and np.abs(force[-2:]).max() > 0.0
    assert np.linalg.norm(force.sum(axis=1), axis=1).max() < 20.0


def test_contact_motion_is_independent_of_tissue_stiffness(box, pressed):
    soft = pressed[0]
    stiff = condense_contact(bodily(box, replace(SOFT, young=7500.0)), [box.tumour_nodes])[0]
    X = features(box, draw_poses("palpation", box, 10, 3))
    force, more = soft.compute_nodal_forces(X), stiff.compute_nodal_forces(X)
    np.testing.assert_allclose(2.5 * force, more, atol=1e-3 * np.abs(more).max())
    moved, again = force @ soft.compliance.T, more @ stiff.compliance.T
    np.testing.assert_allclose(moved, again, atol=2e-6)
    air = X.copy()
    air[:, 6] = 0.0
    assert not soft.predict(air).any()


def test_unit_responses_match_fem_under_small_forces(box):
    """Reference: solves under nodal forces."""
    nodes, at = open_patch(box).nodes[[3, 20]], box.tumour_nodes[:9]
    found = compute_unit_responses(bodily(box, SOFT), nodes, at)
    force = np.zeros((6, len(box.mesh.nodes), 3))
    force[np.arange(6), np.repeat(nodes, 3), np.tile(np.arange(3), 2)] = 1e-4
    truth = Fem(box, [Elasticity(SOFT), Held(), NodalForce()], REFERENCE, "cpu", element="p1").deform(
        Loads((Nodal(force),))
    )
    np.testing.assert_allclose(found, 1e4 * truth.restrict(at).displacement, atol=1e-5 * np.abs(found).max())


@dataclass(frozen=True)
class Stiffening:
    """Answers poses as the ball on linear tissue does, whose forces grow with depth, and with place a little."""

    anatomy: Anatomy
    contact: RigidContact
    bases: list[Basis]

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        X = features(self.anatomy, loads)
        answered = self.contact.compute_linear(X) * X[:, 6:7]
        answered *= (LINE[0] + LINE[1] * X[:, 6:7] / X[:, 7:8]) * (1.0 + 0.1 * np.sin(100.0 * X[:, :1]))
        split, displacement = len(self.bases[0].modes), np.zeros((len(loads), len(self.anatomy.mesh.nodes), 3))
        for basis, coefficients in zip(self.bases, (answered[:, :split], answered[:, split:]), strict=True):
            displacement[:, basis.nodes] = basis.decode(coefficients)
        count, depth = len(loads), X[:, 6:7] / X[:, 7:8]
        force = self.contact.compute_nodal_forces(X).reshape(count, -1, 3).sum(axis=1)
        force *= (GRIP[0] + GRIP[1] * depth) * (1.0 + 0.1 * np.sin(100.0 * X[:, :1]))
        answer = Deformation(
            displacement,
            np.arange(len(self.anatomy.mesh.nodes)),
            (Outcome.CONVERGED,) * count,
            np.zeros(count, int),
            np.zeros(count),
            loads.times,
            compute_wrench(force, get_poses(loads, BALL), BALL),
        )
        return answer if at is None else answer.restrict(at)


@pytest.fixture(scope="module")
def elements(box, pressed):
    return Stiffening(box, *pressed)


@pytest.fixture(scope="module")
def data(tmp_path_factory, elements):
    path = tmp_path_factory.mktemp("touched") / "data.h5"
    said = {"shape": repr(BALL), "tissue": to_tissue_json(SOFT), "effects": "as given", "element": "p1"}
    simulate(path, elements, draw_poses("palpation", elements.anatomy, 160, 0), said)
    return read_dataset(path)


@pytest.fixture(scope="module")
def trained(data):
    return train(data, CONTACT_MODELS)


def test_contact_models_reach_error_and_coverage_limits(trained, elements, box):
    """On held-out discs and new poses; bounds have about their nominal coverage."""
    contact, both = (trained.models[name] for name in CONTACT_MODELS)
    regressor = contact.parts[0].regressor
    assert isinstance(regressor, RigidContact)
    np.testing.assert_allclose(regressor.line[:, 0], LINE, atol=0.1)
    scores = {row.name: row.mean_percent for row in trained.scores}
    assert scores["contact"] < 9.0
    assert scores["contact-gp"] < 0.7 * scores["contact"]
    fresh, nodes = draw_poses("palpation", box, 60, 77), box.tumour_nodes
    truth = elements.deform(fresh, at=nodes).displacement
    error, found = compute_point_errors(both, fresh, truth, nodes), both.deform(fresh, at=nodes)
    assert error.mean() < 0.02 * np.linalg.norm(truth, axis=2).mean()
    assert (error.max(axis=1) <= found.bound[0]).mean() > 0.8
    assert (
        compute_point_errors(contact, fresh, truth, nodes).max(axis=1) <= contact.deform(fresh, at=nodes).bound[0]
    ).mean() > 0.8
    cortex = open_patch(box).nodes
    exact = elements.deform(fresh, at=cortex).displacement
    assert np.linalg.norm(both.deform(fresh, at=cortex).displacement - exact) < 0.05 * np.linalg.norm(exact)


def test_tool_force_is_predicted_with_its_own_bound(data, trained, elements, box):
    contact, both = (trained.models[name] for name in CONTACT_MODELS)
    regressor = contact.parts[0].regressor
    assert isinstance(regressor, RigidContact)
    np.testing.assert_allclose(regressor.grip, GRIP, atol=0.1)
    fresh = draw_poses("palpation", box, 60, 77)
    truth = elements.deform(fresh).reaction
    found, plain = both.deform(fresh), contact.deform(fresh)
    size = np.linalg.norm(truth[:, 0, :3], axis=1)
    error = np.linalg.norm((found.reaction - truth)[:, 0, :3], axis=1)
    assert (error / size).mean() < 0.02
    assert (error / size).mean() < 0.7 * (np.linalg.norm((plain.reaction - truth)[:, 0, :3], axis=1) / size).mean()
    # Moments about the tool's lowest point follow the force.
    assert np.linalg.norm((found.reaction - truth)[:, 0, 3:]) < 0.05 * np.linalg.norm(truth[:, 0, 3:])
    for answer in (found, plain):
        off = np.linalg.norm((answer.reaction - truth)[:, 0, :3], axis=1)
        assert (off <= answer.reaction_bound[0]).mean() > 0.75  # 40 loads calibrate
        assert (answer.reaction_bound[0] < size).mean() > 0.9
    judged = compare_forces(both, fresh, truth[:, 0, :3])
    assert judged.mean_percent == pytest.approx(100.0 * (error / size).mean())
    assert judged.shares is not None and judged.shares[0] == pytest.approx((error <= found.reaction_bound[0]).mean())
    assert trained.force["contact-gp"].mean_percent < trained.force["contact"].mean_percent < 9.0
    lifted = compute_poses(
        BALL, np.array([[0.0, 0.0, 0.1]]), np.array([[0.0, 0.0, -1.0]]), np.array([[0.0, 0.0, -1e-3]])
    )
    assert not both.deform(Loads((lifted,))).reaction.any()


def test_dataset_without_reactions_gives_no_force_model(tmp_path, data, box):
    """Files of older versions end their rows before the reaction; they are read and train models."""
    older = tmp_path / "older.h5"
    shutil.copy(data.path, older)
    with h5py.File(older, "r+") as file:
        rows = np.empty(len(data.loads), get_row_dtype(len(box.mesh.nodes)))
        for name in rows.dtype.names or ():
            rows[name] = file[f"answers/{name}"][:]
        del file["answers/reaction"]
        file["answers/checksum"][:] = compute_row_checksums(rows)
    read = read_dataset(older)
    assert read.read_reaction() is None and data.read_reaction() is not None
    np.testing.assert_array_equal(read.read_displacement(box.tumour_nodes), data.read_displacement(box.tumour_nodes))
    found = train(read, ["contact"])
    assert found.force == {}
    answer = found.models["contact"].deform(draw_poses("palpation", box, 2, 1))
    assert answer.reaction.shape == (2, 0, 6) and np.isnan(answer.reaction_bound).all()


def test_stored_contact_models_predict_same_alone_and_batched(tmp_path, trained, box):
    save(tmp_path / "model.npz", trained.models)
    again, fresh = load(tmp_path / "model.npz", box), draw_poses("palpation", box, 6, 1)
    for name in CONTACT_MODELS:
        together = trained.models[name].deform(fresh).displacement
        np.testing.assert_array_equal(again[name].deform(fresh).displacement, together)
        for what in ("reaction", "reaction_bound"):
            np.testing.assert_array_equal(
                *(getattr(model.deform(fresh), what) for model in (again[name], trained.models[name]))
            )
        alone = [again[name].deform(fresh.select(slice(row, row + 1))).displacement[0] for row in range(6)]
        np.testing.assert_allclose(alone, together, atol=1e-8)


def test_contact_models_require_tissue_and_poses(data):
    assert set(CONTACT_MODELS) < set(list_learners(data))
    untold = replace(data, provenance={"ball": repr(BALL.radius)})
    assert not set(CONTACT_MODELS) & set(list_learners(untold))
    with pytest.raises(InputError, match="does not state its tissue, so series and contact are not available"):
        train(untold, ["contact"])
    pushes = replace(data, provenance={name: said for name, said in data.provenance.items() if name != "shape"})
    with pytest.raises(InputError, match="holds pushes, of which contact-gp cannot be had: choose from linear"):
        train(pushes, ["contact-gp"])
