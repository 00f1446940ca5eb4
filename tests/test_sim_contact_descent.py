"""What touches and what gives, solved apart: each part against the same by other means."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import cast

import numpy as np
import pytest
import warp as wp
from boxes import base_held, box, hold

from sim.accuracy import TRAIN, Accuracy
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, SkullContact, ToolContact
from sim.fem import Fem
from sim.linalg.compliance import Columns, Compliance
from sim.linalg.pcg import Preconditioner
from sim.loads import Loads, Touching
from sim.local_solvers.contact_descent import ContactDescent
from sim.local_solvers.contact_forces import ContactCompliance, ForceLimits, allocate_scratch, solve_contact_forces
from sim.local_solvers.contact_preconditioner import ContactPreconditioner
from sim.material import Material
from sim.minimisers.compact_lbfgs import BatchHistory, CurvaturePairs, build_empty_history
from sim.minimisers.lbfgs_kernels import PAIRS
from sim.runtime.device import Device
from sim.strategy.plan import SolverStep
from sim.tools import Ball

SIDE, HEIGHT, RADIUS = 0.06, 0.03, 6e-3
BODY = base_held(box((6, 6, 3), SIDE))


def at(x: float, y: float, z: float) -> np.ndarray:
    """T_world_tool (4, 4) of an upright tool at a place [m]."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def touching(*poses: np.ndarray) -> Loads:
    """One tool in so many load cases."""
    return Loads((Touching(np.stack(poses)[:, None]),))


DOWN = at(0.031, 0.028, HEIGHT - 3e-3)
ASIDE = at(0.036, 0.03, HEIGHT - 4e-3)


@cache
def solver(accuracy: Accuracy) -> Fem:
    effects = [Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), ToolContact((Ball(RADIUS),))]
    return Fem(BODY, effects, accuracy, "cpu", element="p1")


@cache
def parts() -> tuple[Fem, ContactDescent]:
    """A solver, and its descent."""
    fem = solver(Accuracy(1e-6))
    found = fem.strategy.contact
    assert found is not None
    return fem, found


class Rough:
    """What a preconditioner does, each number off by up to a share; it makes all columns by itself."""

    def __init__(self, whole: Preconditioner, share: float):
        self._whole, self._share, self._random = whole, share, np.random.default_rng(5)

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        self._whole.apply(r, live, out)
        out.assign(out.numpy() * (1.0 + self._share * self._random.uniform(-1.0, 1.0, out.shape)))


def bfgs(inverse: np.ndarray, steps: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Nocedal, Wright 2006, equation 6.17, pair after pair."""
    for s, y in zip(steps, changes, strict=True):
        left = np.eye(len(s)) - np.outer(s, y) / (s @ y)
        inverse = left @ inverse @ left.T + np.outer(s, s) / (s @ y)
    return inverse


def learnt_pairs(count: int) -> tuple[CurvaturePairs, np.ndarray, np.ndarray]:
    """Pairs of random steps (the last PAIRS count), the inverse they began with and the one that BFGS has."""
    rng, size = np.random.default_rng(5), 30
    stiffness, change = (matrix @ matrix.T for matrix in rng.normal(size=(2, size, size)))
    begun = np.linalg.inv(stiffness + size * np.eye(size))
    steps = rng.normal(size=(count, size))
    changes = steps @ (stiffness + change)
    pairs = build_empty_history(size, "float64")
    for s, y in zip(steps, changes, strict=True):
        pairs = pairs.add_pair(s, y, begun @ y)
    return pairs, begun, bfgs(begun, steps[-PAIRS:], changes[-PAIRS:])


@pytest.mark.parametrize("count", [0, 1, 3, PAIRS, PAIRS + 3])
def test_pairs_are_those_of_bfgs(count: int) -> None:
    pairs, begun, expected = learnt_pairs(count)
    force = np.random.default_rng(6).normal(size=len(begun))
    np.testing.assert_allclose(
        begun @ force + pairs.compute_motion(pairs.compute_weights(force)), expected @ force, rtol=1e-8
    )


def test_each_column_learns_and_forgets_by_itself() -> None:
    """Against BFGS: one column is always there, one learns late, one has more than fit, one has forgotten."""
    rng, size = np.random.default_rng(5), 30
    stiffness, change = (matrix @ matrix.T for matrix in rng.normal(size=(2, size, size)))
    begun = np.linalg.inv(stiffness + size * np.eye(size))
    pairs, known = BatchHistory(Device("cpu", "float64"), size, 4), [[] for _ in range(4)]
    for turn in range(PAIRS + 3):
        columns = np.array([0, 1, 2, 3] if turn < 2 else [0, 2] if turn < PAIRS else [2])
        s = rng.normal(size=(size, len(columns)))
        y = (stiffness + change) @ s
        pairs.update_history(columns, s, y, begun @ y)
        for place, column in enumerate(columns):
            known[column].append((s[:, place], y[:, place]))
    pairs.forget(np.array([3]))
    pairs.keep(np.array([2, 1, 3]))
    force = rng.normal(size=(size, 3))
    learnt = pairs.get_history(np.arange(3))
    found = begun @ force + learnt.compute_motion(learnt.compute_weights(force))
    for place, column in enumerate((2, 1, 3)):
        last = [] if column == 3 else known[column][-PAIRS:]
        steps, changes = (np.array([pair[i] for pair in last]).reshape(-1, size) for i in range(2))
        np.testing.assert_allclose(found[:, place], bfgs(begun, steps, changes) @ force[:, place], rtol=1e-7)


def test_columns_are_what_the_preconditioner_does() -> None:
    fem, descent = parts()
    soft, rng = descent.compliance, np.random.default_rng(1)
    nodes = soft.nodes
    assert np.array_equal(nodes[: len(descent.barrier.touchable)], descent.barrier.touchable)
    force = np.zeros((len(nodes), 3, 2))
    some = rng.permutation(len(nodes))[:5]
    force[some] = rng.normal(size=(5, 3, 2))
    force = force.reshape(-1, 2)
    whole = np.zeros((fem.problem.rows, 2))
    whole[soft.rows] = force
    expected = soft.apply(whole)
    size = np.abs(expected).max()
    np.testing.assert_allclose(soft.spread(force), expected, atol=1e-6 * size)
    between = soft.build_matrix(np.isin(np.arange(len(nodes)), some))
    np.testing.assert_allclose(between @ force, expected[soft.rows], atol=1e-6 * size)
    np.testing.assert_allclose(soft.compute_motion(force), expected[soft.rows], atol=1e-6 * size)


def test_columns_are_bit_identical_in_any_order() -> None:
    fem, descent = parts()
    nodes, preconditioner = descent.barrier.touchable, cast(Preconditioner, Rough(fem.strategy.preconditioner, 0.0))
    assert len(nodes) > 3 * Columns().block
    one, other = (Compliance(fem.problem, preconditioner, nodes) for _ in range(2))
    every = np.ones(len(nodes), bool)
    other.build_matrix(np.arange(len(nodes)) == len(nodes) - 1)
    np.testing.assert_array_equal(one.build_matrix(every), other.build_matrix(every))


@pytest.mark.parametrize("definite", [False, True])
def test_the_reduced_barrier_is_the_whole_one(definite: bool) -> None:
    """Its gradient, and its curvature against the term's own product."""
    fem, descent = parts()
    problem, term, nodes = fem.problem, descent.barrier, descent.barrier.touchable
    problem.begin(Cases(touching(DOWN), np.zeros(1)))
    rng = np.random.default_rng(2)
    u = 1e-4 * rng.normal(size=(problem.rows, 1))
    rows, place = descent.compliance.rows[: 3 * len(nodes)], problem.device.upload(u)
    expected = problem.device.allocate(problem.rows, 1)
    term.add_gradient(place, expected)
    barrier = term.reduce(np.zeros(1, int))
    assert barrier is not None and np.abs(expected.numpy()).max() > 1e-3
    np.testing.assert_allclose(barrier.slope(u[rows]), expected.numpy()[rows], rtol=1e-9, atol=1e-12)
    p, product = rng.normal(size=(problem.rows, 1)), problem.device.allocate(problem.rows, 1)
    problem.linearise(place, np.array([definite]))
    term.add_curvature(problem.device.upload(p), product)
    every = np.arange(len(nodes))[:, None]
    matrix = barrier.curvature(u[rows], every, len(nodes), np.array([definite]))[0]
    np.testing.assert_allclose(matrix @ p[rows], product.numpy()[rows], rtol=1e-8, atol=1e-9 * np.abs(matrix).max())


def test_what_is_touched_is_known_to_the_preconditioner() -> None:
    """It is the inverse of the rest stiffness and the barrier's curvature: that times it is what it was given."""
    fem, descent = parts()
    problem, preconditioner = fem.problem, fem.strategy.preconditioner
    problem.begin(Cases(touching(DOWN), np.zeros(1)))
    problem.linearise(problem.device.allocate(problem.rows, 1), np.ones(1, bool))
    touched = ContactPreconditioner(preconditioner, descent.compliance, descent.barrier)
    touched.prepare(problem, 1)
    r = problem.device.upload(np.random.default_rng(3).normal(size=(problem.rows, 1)))
    problem.constraint.project(r)

    def missed(one: Preconditioner) -> float:
        x, back = wp.zeros_like(r), wp.zeros_like(r)
        one.apply(r, np.ones(1, bool), x)
        problem.add_curvature(x, back)  # at rest, elastic tissue has its rest stiffness
        problem.constraint.project(back)
        return float(np.linalg.norm(back.numpy() - r.numpy()) / np.linalg.norm(r.numpy()))

    assert missed(touched) < 1e-2  # a factor is kept in single precision
    assert missed(preconditioner) > 1.0


def test_contact_preconditioner_includes_skull() -> None:
    """The answer is the same, in fewer linear iterations."""
    mesh, down = box((12, 12, 6), SIDE), at(0.031, 0.028, HEIGHT - 5e-3)
    wall = np.where((mesh.nodes[:, :1] > SIDE - 1e-9) & (mesh.nodes[:, 2:] > 1e-9), [1.0, 0.0, 0.0], 0.0)
    effects = [Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), SkullContact(), ToolContact((Ball(RADIUS),))]
    fem = Fem(hold(mesh, mesh.nodes[:, 2] < 1e-9, wall), effects, Accuracy(1e-7), "cpu", element="p1")
    knowing, plain = fem.strategy, replace(fem.strategy)
    vars(plain)["_touched"] = fem.strategy.preconditioner
    found, expected = (one.solve(Cases(touching(down), np.zeros(1)), []) for one in (knowing, plain))
    assert knowing.contact is None and found.good.all() and expected.good.all()
    np.testing.assert_allclose(found.u.numpy(), expected.u.numpy(), atol=1e-8)
    assert found.linear_iterations < expected.linear_iterations / 1.5


def test_an_answer_alone_is_that_in_a_batch() -> None:
    """Columns that take other ways, and end after other numbers of steps, do not feel each other."""
    fem, shallow = solver(Accuracy(1e-8)), at(0.02, 0.02, HEIGHT + RADIUS - 2e-4)
    poses = (ASIDE, shallow, DOWN, at(0.04, 0.012, HEIGHT - 5e-3))
    batch = fem.deform(touching(*poses))
    assert all(outcome.good for outcome in batch.outcome)
    assert len(set(batch.iterations.tolist())) > 1
    for row, pose in enumerate(poses):
        alone = fem.deform(touching(pose))
        np.testing.assert_allclose(alone.displacement[0], batch.displacement[row], atol=1e-9)
        np.testing.assert_allclose(alone.reaction[0], batch.reaction[row], rtol=1e-6, atol=1e-9)


def test_contact_solved_apart_is_what_newton_finds() -> None:
    """Of deep poses too, where the model of the tissue misleads."""
    effects = [Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), ToolContact((Ball(RADIUS),))]
    poses = touching(DOWN, at(0.031, 0.028, HEIGHT - 6e-3), at(0.012, 0.045, HEIGHT - 5e-3))
    newton = Fem(BODY, effects, Accuracy(1e-7), "cpu", element="p1", avoid=(SolverStep.CONTACT,)).deform(poses)
    found = solver(Accuracy(1e-7)).deform(poses)
    assert all(outcome.good for outcome in (*newton.outcome, *found.outcome))
    np.testing.assert_allclose(found.displacement, newton.displacement, atol=1e-8)


@pytest.mark.parametrize(("drag", "rough"), [(0.0, 0.0), (0.5, 0.0), (0.0, 1e-3)])
def test_forces_are_those_of_tools_where_nodes_go_under_them(drag: float, rough: float) -> None:
    """f = c'(w) + d (w - v) where that is not zero, w = w1 - C (f - f1): of each column by itself, in a few steps.

    A preconditioner in half precision rounds each of C's columns by itself.
    """
    fem, descent = parts()
    whole, n = fem.strategy.preconditioner, len(descent.barrier.touchable)

    soft = Compliance(fem.problem, cast(Preconditioner, Rough(whole, rough)), descent.barrier.touchable)
    device = replace(fem.problem.device, precision="float64")
    shallow = (at(0.031, 0.028, HEIGHT - 3e-4), at(0.02, 0.02, HEIGHT - 2e-4), at(0.0, 0.0, 0.2))
    fem.problem.begin(Cases(touching(*shallow), np.zeros(3)))
    barrier = descent.barrier.reduce(np.arange(3))
    assert barrier is not None
    here, known = np.zeros((3 * n, 3)), np.zeros((3 * n, 3))
    model, few = ContactCompliance(soft, device, partial(allocate_scratch, device)), ForceLimits(max_iterations=20)
    force, found = solve_contact_forces(
        barrier, model, here, here + 1e-4, known, np.full(3, 1e-6), np.full(3, drag), few
    )
    assert found.all() and not force[:, 2].any()
    between = soft.build_matrix(np.ones(n, bool))
    w = here + 1e-4 - 0.5 * (between + between.T) @ force
    slope, touched = barrier.slope(w), (barrier.slope(here) != 0.0).reshape(n, 3, 3).any(axis=1)
    for column in range(2):
        rows = np.repeat(touched[:, column], 3)
        stiff = drag / np.diag(between)[rows].mean()
        slope[rows, column] += stiff * w[rows, column]
        np.testing.assert_allclose(force[:, column], slope[:, column], atol=1e-5 * np.abs(slope[:, column]).max())


def test_a_batch_of_which_one_case_is_slow_goes_on() -> None:
    """What that one case learns, when it alone is left, is not the batch's."""
    fem, far = solver(Accuracy(1e-6)), touching(DOWN, at(0.045, 0.04, HEIGHT - 3e-3))
    second = fem.deform(far, fem.deform(touching(DOWN, DOWN)))
    assert {len(value) for value in second.memory.values()} == {2}
    third = fem.deform(far, second)
    assert all(outcome.good for outcome in third.outcome)
    np.testing.assert_allclose(third.displacement, second.displacement, atol=1e-5)


def test_no_poses_no_answers() -> None:
    fem = solver(Accuracy(1e-6))
    none = fem.deform(touching(DOWN).select(np.zeros(0, int)))
    assert none.displacement.shape == (0, len(BODY.mesh.nodes), 3)


def test_what_was_asked_before_changes_no_bit() -> None:
    fem = solver(TRAIN)
    begun = fem.deform(touching(DOWN))
    first = fem.deform(touching(ASIDE), begun)
    fem.deform(touching(at(0.012, 0.045, HEIGHT - 2e-3)))
    again = fem.deform(touching(ASIDE), begun)
    np.testing.assert_array_equal(first.displacement, again.displacement)
    np.testing.assert_array_equal(first.reaction, again.reaction)
    for name, array in first.memory.items():
        np.testing.assert_array_equal(array, again.memory[name])
