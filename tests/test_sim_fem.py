"""Conformance suite for every deformer, and further properties of finite elements."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from boxes import base_held, box, hold, top_forces
from oracle import internal_forces

from sim.accuracy import DRAFT, LIVE, REFERENCE, TRAIN, Accuracy
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Deformer, Outcome
from sim.discretisation.footprint import compute_footprint_weights
from sim.effects import Elasticity, Held, NodalForce, ToolDisplacement, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Displaced, Loads, Nodal, Prescribed, Pushed, push
from sim.material import Material
from surrogate.data.dataset import read_dataset
from surrogate.data.simulate import simulate
from surrogate.training.train import train

BLOCK = box((3, 3, 3), 0.1, distortion=0.1)
MESH = TetMesh(
    BLOCK.nodes, BLOCK.tets, np.where(np.linalg.norm(BLOCK.nodes[BLOCK.tets].mean(axis=1) - 0.05, axis=1) < 0.03, 2, 1)
)
ANATOMY = replace(base_held(MESH), craniotomy=MESH.nodes[:, 2] > 0.1 - 1e-9)
COUNT = len(MESH.nodes)
EFFECTS = Elasticity(), Held(), ToolForce()
FORCE = np.array([[0.0, 0.0, -0.05], [0.02, -0.03, -0.3], [0.1, 0.0, -0.6], [0.0, 0.1, 0.2], [0.0, 0.0, -0.9]])
POINT = np.array([[0.05, 0.05, 0.1], [0.04, 0.06, 0.1], [0.07, 0.05, 0.1], [0.05, 0.03, 0.1], [0.06, 0.06, 0.1]])


@dataclass(frozen=True)
class Candidate:
    """A deformer to put through the suite; `error` is what it may differ by from itself, over the largest motion."""

    build: Callable[[], Deformer]
    error: float


def fem(accuracy: Accuracy, element: str = "p1") -> Callable[[], Deformer]:
    return lambda: Fem(ANATOMY, EFFECTS, accuracy, "cpu", batch=3, element=element)


def learned(learner: str) -> Callable[[], Deformer]:
    """Trained on pushes and pulls all over the top, by the reference."""

    def build() -> Deformer:
        random = np.random.default_rng(0)
        point = np.column_stack([random.uniform(0.02, 0.08, (60, 2)), np.full(60, 0.1)])
        force = random.normal(size=(60, 3)) * random.uniform(0.02, 1.0, (60, 1))
        with TemporaryDirectory() as folder:
            path = Path(folder) / "data.h5"
            simulate(
                path,
                Fem(ANATOMY, [*EFFECTS, NodalForce()], REFERENCE, "cpu", element="p1"),
                push(point, force, 0.02),
                {},
            )
            return replace(train(read_dataset(path), [learner]).models[learner], anatomy=ANATOMY)

    return build


DEFORMERS = {
    "fem float64": Candidate(fem(REFERENCE), 1e-6),
    "fem float32": Candidate(fem(TRAIN), 2e-3),
    "fem p2": Candidate(fem(REFERENCE, "p2"), 1e-6),
    "fem p2 float32": Candidate(fem(TRAIN, "p2"), 2e-3),
    "fem smoothed": Candidate(fem(REFERENCE, "smoothed"), 1e-6),
    "learned linear": Candidate(learned("linear"), 1e-5),
    "learned svr": Candidate(learned("svr"), 1e-5),
    "learned residual": Candidate(learned("residual"), 1e-5),
}
"""Deformers of `ANATOMY` that answer `Pushed` loads: add a line for a new one."""


@cache
def built(name: str) -> Deformer:
    return DEFORMERS[name].build()


@cache
def answered(name: str) -> Deformation:
    return built(name).deform(loads())


def loads(rows: slice | np.ndarray = slice(None), scale: float = 1.0, time: float = 0.0) -> Loads:
    whole = push(POINT, scale * FORCE, 0.02)
    return replace(whole, time=np.full(len(whole), time) + 0.1 * np.arange(len(whole))).select(rows)


class TestEveryDeformer:
    @pytest.fixture(params=DEFORMERS)
    def name(self, request: pytest.FixtureRequest) -> str:
        return request.param

    @pytest.fixture
    def deformer(self, name: str, short_fits: None) -> Deformer:
        return built(name)

    @pytest.fixture
    def answer(self, name: str, deformer: Deformer) -> Deformation:
        return answered(name)

    @pytest.fixture
    def error(self, name: str) -> float:
        return DEFORMERS[name].error

    def test_model_is_a_deformer_of_its_anatomy(self, deformer: Deformer) -> None:
        assert isinstance(deformer, Deformer)
        assert deformer.anatomy is ANATOMY

    def test_deformation_has_one_row_for_each_load(self, deformer: Deformer) -> None:
        for count in (0, 1, 2, 5):
            found = deformer.deform(loads(np.arange(count)))
            assert len(found) == len(found.outcome) == count
            assert found.displacement.shape == (count, len(found.nodes), 3)
            assert found.iterations.shape == found.residual.shape == found.time.shape == (count,)
            assert found.reaction.ndim == 3
            assert found.reaction.shape[::2] == (count, 6)

    def test_deformation_is_finite_and_has_a_good_outcome(self, answer: Deformation) -> None:
        assert np.isfinite(answer.displacement).all()
        assert np.isfinite(answer.reaction).all()
        assert all(isinstance(outcome, Outcome) and outcome.good for outcome in answer.outcome)
        assert all(len(outcome.value.split()) >= 5 for outcome in answer.outcome)
        assert np.linalg.norm(answer.displacement, axis=2).max(axis=1).min() > 1e-4

    def test_deform_is_deterministic(self, deformer: Deformer, answer: Deformation) -> None:
        """The same loads give the same bits after other loads were solved."""
        deformer.deform(loads(np.array([4, 2]), scale=-0.5), None)
        again = deformer.deform(loads())
        np.testing.assert_array_equal(answer.displacement, again.displacement)
        np.testing.assert_array_equal(answer.reaction, again.reaction)
        np.testing.assert_array_equal(answer.iterations, again.iterations)
        assert answer.outcome == again.outcome
        warm = [deformer.deform(loads(scale=1.1), answer).displacement for _ in range(2)]
        np.testing.assert_array_equal(*warm)

    def test_deform_does_not_change_its_arguments(self, deformer: Deformer, answer: Deformation) -> None:
        given, start = loads(scale=0.9), answer
        copies = [cause.force.copy() for cause in given.causes if isinstance(cause, Pushed)], start.displacement.copy()
        deformer.deform(given, start)
        np.testing.assert_array_equal([c.force for c in given.causes if isinstance(c, Pushed)], copies[0])
        np.testing.assert_array_equal(start.displacement, copies[1])

    def test_deformation_rows_are_independent(self, deformer: Deformer, answer: Deformation, error: float) -> None:
        """In any order, and for any partition of the batch."""
        whole, scale = answer.displacement, np.abs(answer.displacement).max()
        order = np.array([3, 0, 4, 1, 2])
        np.testing.assert_allclose(deformer.deform(loads(order)).displacement, whole[order], atol=error * scale)
        for row in (0, 2, 4):
            alone = deformer.deform(loads(np.array([row]))).displacement[0]
            np.testing.assert_allclose(alone, whole[row], atol=error * scale)

    def test_deform_returns_only_selected_vertices(self, deformer: Deformer, answer: Deformation) -> None:
        picked = answer.nodes[[5, 2, 11]]
        some = deformer.deform(loads(), at=picked)
        np.testing.assert_array_equal(some.nodes, picked)
        np.testing.assert_allclose(some.displacement, answer.displacement[:, [5, 2, 11]], rtol=0.0, atol=1e-10)
        np.testing.assert_array_equal(answer.restrict(picked).displacement, answer.displacement[:, [5, 2, 11]])
        with pytest.raises(InputError, match=f"vertex {COUNT}"):
            deformer.deform(loads(), at=np.array([COUNT]))

    def test_zero_load_causes_no_displacement(self, deformer: Deformer, answer: Deformation) -> None:
        """Exactly: from rest, from a warm start, alone and among others."""
        still = push(POINT, np.zeros((5, 3)), 0.02)
        assert not deformer.deform(still).displacement.any()
        assert not deformer.deform(still, answer).displacement.any()
        mixed = push(POINT, FORCE * np.array([[1.0], [0.0], [1.0], [0.0], [1.0]]), 0.02)
        found = deformer.deform(mixed).displacement
        assert not found[[1, 3]].any()
        assert found[[0, 2, 4]].any(axis=(1, 2)).all()

    def test_deformation_has_times_of_its_loads(self, deformer: Deformer) -> None:
        given = loads(time=2.5)
        np.testing.assert_array_equal(deformer.deform(given).time, given.times)

    def test_deformation_reports_its_cost(self, deformer: Deformer) -> None:
        cost = deformer.deform(loads()).cost
        assert cost.total > 0.0
        assert min(cost.seconds.values()) >= 0.0
        assert cost.total == pytest.approx(sum(cost.seconds.values()))

    def test_warm_start_only_reduces_iterations(self, deformer: Deformer, answer: Deformation, error: float) -> None:
        warm = deformer.deform(loads(), deformer.deform(loads(scale=0.95)))
        assert (warm.iterations <= answer.iterations).all()
        scale = np.abs(answer.displacement).max()
        np.testing.assert_allclose(warm.displacement, answer.displacement, atol=error * scale)

    def test_start_at_solution_needs_no_iterations(self, deformer: Deformer, answer: Deformation) -> None:
        again = deformer.deform(loads(), answer)
        np.testing.assert_array_equal(again.iterations, 0)

    def test_larger_push_causes_larger_displacement(self, deformer: Deformer, answer: Deformation) -> None:
        each = [*(deformer.deform(loads(scale=scale)) for scale in (0.3, 0.6)), answer]
        assert (np.diff([np.abs(found.displacement).max(axis=(1, 2)) for found in each], axis=0) > 0.0).all()

    def test_loads_of_another_kind_are_rejected(self, deformer: Deformer) -> None:
        with pytest.raises(InputError, match="Displaced"):
            deformer.deform(Loads((Displaced(POINT, FORCE, np.full(5, 0.02)),)))

    def test_loads_outside_the_body_are_rejected(self, deformer: Deformer) -> None:
        with pytest.raises(InputError, match="does not touch"):
            deformer.deform(push([0.0, 0.0, 1.0], [0.0, 0.0, -0.1], 0.01))

    def test_start_with_other_number_of_rows_is_rejected(self, deformer: Deformer, answer: Deformation) -> None:
        with pytest.raises(InputError, match=r"start has displacements of shape \(5, "):
            deformer.deform(loads(np.arange(2)), answer)


@pytest.mark.parametrize("size", [1, 2, 5, 64])
def test_batch_size_does_not_change_the_result(size: int) -> None:
    whole = built("fem float64").deform(loads(time=1.0))
    split = Fem(ANATOMY, EFFECTS, REFERENCE, "cpu", batch=size, element="p1").deform(loads(time=1.0))
    np.testing.assert_allclose(split.displacement, whole.displacement, atol=1e-9)
    np.testing.assert_allclose(split.reaction, whole.reaction, atol=1e-12)
    np.testing.assert_array_equal(split.iterations, whole.iterations)
    np.testing.assert_array_equal(split.time, whole.time)
    assert split.outcome == whole.outcome


def test_loads_of_several_kinds_add_up() -> None:
    """A push with nodal forces is the sum of both as nodal forces."""
    both = Fem(ANATOMY, [*EFFECTS, NodalForce()], REFERENCE, "cpu", element="p1")
    top = top_forces(MESH, FORCE / 3.0)
    found = both.deform(Loads((*loads().causes, Nodal(top)))).displacement
    share = compute_footprint_weights(MESH.nodes, MESH.surface, POINT, np.full(5, 0.02)).toarray()
    pushed = share[:, :, None] * FORCE[:, None]
    alone = Fem(ANATOMY, [Elasticity(), Held(), NodalForce()], REFERENCE, "cpu", element="p1").deform(
        Loads((Nodal(top + pushed),))
    )
    np.testing.assert_allclose(found, alone.displacement, atol=1e-8)


def test_tiny_and_large_tool_displacements_are_both_exact() -> None:
    """Columns of very different size, in single precision: each reaches its own value."""
    body = Fem(ANATOMY, [Elasticity(), Held(), ToolDisplacement()], TRAIN, "cpu", element="p1")
    motion = np.array([[0.0, 0.0, -1e-6], [0.0, 0.0, -1e-2], [1e-4, 0.0, 0.0]])
    found = body.deform(Loads((Displaced(POINT[:3], motion, np.full(3, 0.03)),)))
    assert all(outcome.good for outcome in found.outcome)
    weight = compute_footprint_weights(MESH.nodes, MESH.surface, POINT[:3], np.full(3, 0.03)).toarray()
    mean = np.einsum("bv,bvi->bi", weight, found.displacement)
    assert (np.linalg.norm(mean - motion, axis=1) < 1e-5 * np.linalg.norm(motion, axis=1)).all()


def stubborn() -> tuple[Anatomy, Loads]:
    """The top is pulled to three times the height and turned aside."""
    top = MESH.nodes[:, 2] > 0.1 - 1e-9
    value = np.where(top[:, None], [0.15, 0.0, 0.2], 0.0)
    return hold(MESH, ANATOMY.fixed.all(axis=1) | top), Loads((Prescribed(value[None]),))


def test_load_steps_solve_case_where_newton_fails() -> None:
    anatomy, asked = stubborn()
    effects = Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held()
    patient = Fem(anatomy, effects, Accuracy(1e-8, limit_strain=False), "cpu", element="p1").deform(asked)
    assert patient.outcome == (Outcome.CONVERGED,)
    few = Accuracy(1e-8, outer=int(patient.iterations[0]) - 2, limit_strain=False)
    hasty = Fem(anatomy, effects, few, "cpu", element="p1").deform(asked)
    assert hasty.outcome == (Outcome.CONVERGED_IN_STEPS,)
    assert hasty.outcome[0].good
    assert hasty.iterations[0] > patient.iterations[0]
    assert hasty.residual[0] <= 1e-8
    np.testing.assert_allclose(hasty.displacement, patient.displacement, atol=1e-6)


def test_load_steps_of_one_row_leave_other_rows_unchanged() -> None:
    anatomy, asked = stubborn()
    effects = Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held()
    value = asked.get(Prescribed)
    assert value is not None
    three = Loads((Prescribed(value.displacement * np.array([0.01, 1.0, 0.02])[:, None, None]),))
    body = Fem(anatomy, effects, Accuracy(1e-8, outer=8, limit_strain=False), "cpu", element="p1")
    found = body.deform(three)
    assert found.outcome[0] is found.outcome[2] is Outcome.CONVERGED
    assert found.outcome[1] is Outcome.CONVERGED_IN_STEPS
    for row in range(3):
        alone = body.deform(three.select(np.array([row])))
        np.testing.assert_allclose(alone.displacement[0], found.displacement[row], atol=1e-8)


@pytest.mark.parametrize("law", ["neo-hookean", "stable-neo-hookean"])
def test_unsolvable_case_returns_its_last_accepted_state(law: str) -> None:
    """Two steps for a load of 50 N: reported as not converged, finite, beyond rest; the other rows are not affected."""
    body = Fem(
        ANATOMY,
        [Elasticity(Material(law, 3000.0, 0.45)), Held(), NodalForce()],
        Accuracy(tolerance=1e-8, outer=2),
        "cpu",
        element="p1",
    )
    force = top_forces(MESH, np.array([[0.0, 0.0, -50.0], [0.0, 0.0, -1e-5]]))
    found = body.deform(Loads((Nodal(force),)))
    assert found.outcome[0] is Outcome.BUDGET
    assert not found.outcome[0].good
    assert found.outcome[1] is Outcome.CONVERGED
    assert np.isfinite(found.displacement).all()
    assert found.displacement[0].any()
    assert found.residual[0] > 1e-8
    # Its own budget and that of the load steps: no rescue without end.
    assert 2 < found.iterations[0] <= 2 + 2 * body.accuracy.steps
    assert found.reached[0] == 0.0
    assert found.reached[1] == 1.0


def test_too_large_load_stops_at_reachable_share() -> None:
    """The top is pressed through the base: under the share that is reached an independent residual vanishes."""
    mesh = box((2, 2, 2), 0.1)
    top = mesh.nodes[:, 2] > 0.1 - 1e-9
    value = np.where(top[:, None], [0.0, 0.0, -0.11], 0.0)
    material = Material("neo-hookean", 3000.0, 0.45)
    held = (mesh.nodes[:, 2] < 1e-9) | top
    body = Fem(hold(mesh, held), [Elasticity(material), Held()], Accuracy(tolerance=1e-8), "cpu", element="p1")
    found = body.deform(Loads((Prescribed(value[None]),)))
    assert not found.outcome[0].good
    assert 0.7 < found.reached[0] < 10.0 / 11.0
    np.testing.assert_allclose(found.displacement[0, top], found.reached[0] * value[top], rtol=1e-12)
    force = internal_forces(mesh, {0: material}, found.displacement[0])
    assert np.linalg.norm(force[~held]) < 1.1e-8 * np.linalg.norm(force)
    assert found.inverted[0] == 0
    assert found.residual[0] > 0.05  # of the motion is missing


def test_draft_accuracy_takes_no_load_steps() -> None:
    found = Fem(ANATOMY, EFFECTS, DRAFT, "cpu", element="p1").deform(loads(scale=10.0))
    assert max(found.iterations) == DRAFT.outer
    assert not all(outcome.good for outcome in found.outcome)


def test_overflow_is_reported_and_result_is_finite() -> None:
    body = Fem(ANATOMY, [Elasticity(), Held(), NodalForce()], TRAIN, "cpu", element="p1")
    found = body.deform(Loads((Nodal(top_forces(MESH, np.array([[0.0, 0.0, -1e30], [0.0, 0.0, -0.1]]))),)))
    assert found.outcome == (Outcome.NOT_FINITE, Outcome.CONVERGED)
    assert np.isfinite(found.displacement).all()


@pytest.mark.parametrize("law", ["corotational", "neo-hookean", "stable-neo-hookean"])
def test_solver_converges_under_extreme_loads(law: str) -> None:
    """10 N on a 10 cm box of 3 kPa: strains of several hundred per cent."""
    effects = [Elasticity(Material(law, 3000.0, 0.45)), Held(), NodalForce()]
    force = top_forces(MESH, np.array([[3.0, 2.0, -9.0], [0.0, 0.0, 10.0], [10.0, 0.0, 0.0]]))
    limited, free = (
        Fem(ANATOMY, effects, Accuracy(1e-6, limit_strain=limit), "cpu", element="p1").deform(Loads((Nodal(force),)))
        for limit in (True, False)
    )
    assert all(outcome.good for outcome in free.outcome)
    assert {Outcome.OVERSTRAINED, Outcome.INVERTED} & set(limited.outcome)
    np.testing.assert_array_equal(limited.displacement, free.displacement)


@pytest.mark.parametrize("poisson", [0.0, 0.49, 0.499, -0.4])
def test_solver_converges_for_each_poissons_ratio(poisson: float) -> None:
    effects = [Elasticity(Material("neo-hookean", 3000.0, poisson)), Held(), ToolForce()]
    body = Fem(ANATOMY, effects, REFERENCE, "cpu", element="p1")
    assert all(outcome.good for outcome in body.deform(loads()).outcome)


def test_solver_converges_for_thousandfold_stiffness_contrast() -> None:
    inner = np.linalg.norm(MESH.nodes[MESH.tets].mean(axis=1) - 0.05, axis=1) < 0.03
    mesh = TetMesh(MESH.nodes, MESH.tets, inner.astype(int))
    for young in (3.0, 3e6):
        regions = {1: Material("stable-neo-hookean", young, 0.45)}
        body = Fem(base_held(mesh), [Elasticity(regions=regions), Held(), ToolForce()], REFERENCE, "cpu", element="p1")
        assert all(outcome.good for outcome in body.deform(loads()).outcome)


def test_accuracy_presets_meet_their_tolerance() -> None:
    """Coarser presets differ from the reference as expected by their tolerance, in rising order."""
    exact = built("fem float64").deform(loads()).displacement
    errors = []
    for accuracy in (TRAIN, LIVE, DRAFT):
        found = Fem(ANATOMY, EFFECTS, replace(accuracy, outer=60), "cpu", element="p1").deform(loads()).displacement
        errors.append(np.linalg.norm(found - exact) / np.linalg.norm(exact))
    assert errors[0] < 1e-3
    assert errors[1] < 1e-2
    assert errors[2] < 5e-2


def test_deformation_rejects_non_finite_displacements() -> None:
    good = built("fem float64").deform(loads())
    with pytest.raises(AssertionError, match="non-finite"):
        replace(good, displacement=np.full_like(good.displacement, np.nan))


def test_unknown_device_is_rejected() -> None:
    with pytest.raises(InputError, match="no device 'abacus'"):
        Fem(ANATOMY, EFFECTS, device="abacus", element="p1")
