"""Stiffness update of strained tissue: each part against another method."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp
from boxes import base_held, box

from sim.accuracy import Accuracy
from sim.discretisation.problem import Problem
from sim.discretisation.term import Cases, StrainTerm
from sim.effects import Elasticity, Held, ToolContact
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.local_solvers.contact_descent import ContactDescent
from sim.local_solvers.strained_part import STRAIN_LIMITS, StrainedModel, StrainedPart, StrainLimits
from sim.material import Material
from sim.terms.elasticity import ElasticTerm
from sim.tools import Ball

SIDE, HEIGHT, RADIUS = 0.06, 0.03, 6e-3
BODY = base_held(box((6, 6, 3), SIDE))
EVERY = StrainLimits(min_strain=0.0, max_nodes=10**4)
BOTH = np.arange(2)
TISSUES = {
    "plain": Material("neo-hookean", 3000.0, 0.45),
    "relaxing": Material("neo-hookean", 3000.0, 0.45, prony=((0.4, 2.0),)),
}


def down(*depths: float) -> Loads:
    """A ball over the middle of the box, so deep in it."""
    T = np.repeat(np.eye(4)[None, None], len(depths), axis=0)
    T[:, 0, :2, 3], T[:, 0, 2, 3] = (0.031, 0.028), HEIGHT - np.array(depths)
    return Loads((Touching(T),), np.ones(len(depths)))


@cache
def solver(
    element: str = "p1", tissue: str = "plain", strains: StrainLimits = STRAIN_LIMITS, tolerance: float = 1e-8
) -> tuple[Fem, ContactDescent]:
    """Finite elements under a ball, in double precision, whose descent has these settings."""
    effects = [Elasticity(TISSUES[tissue]), Held(), ToolContact((Ball(RADIUS),))]
    fem = Fem(BODY, effects, Accuracy(tolerance), "cpu", element=element)
    assert fem.strategy.contact is not None
    descent = replace(fem.strategy.contact, strains=strains)
    fem.strategy.__dict__["contact"] = descent
    return fem, descent


def bent(problem: Problem, size: float) -> wp.array:
    """Two columns: nodes moved at random, and a quarter as far."""
    motion = problem.device.upload(size * np.random.default_rng(3).normal(size=(problem.rows, 1)) * [[1.0, 0.25]])
    problem.constraint.project_nodes(motion)
    return motion


def stiffer(fem: Fem, u: wp.array, column: int) -> np.ndarray:
    """K(u) - K(0) (3N, 3N) [N/m] of one column, assembled from the terms' own curvature."""
    problem, parts = fem.problem, []
    problem.begin(Cases(down(1e-3), np.zeros(1)))
    for definite in (False, True):
        problem.linearise(problem.device.upload(u.numpy()[:, [column]]), np.array([definite]))
        parts.append(np.zeros((problem.rows, problem.rows)))
        for first in range(problem.rows):
            p, out = problem.device.allocate(problem.rows, 1), problem.device.allocate(problem.rows, 1)
            p.numpy()[first] = 1.0
            for term in problem.terms:
                if isinstance(term, ElasticTerm):
                    term.add_curvature(p, out)
            parts[-1][:, first] = out.numpy()[:, 0]
    return parts[0] - parts[1]


@pytest.mark.parametrize(("element", "tissue"), [("p1", "plain"), ("smoothed", "plain"), ("p1", "relaxing")])
def test_update_curvature_is_excess_over_rest_curvature(element: str, tissue: str) -> None:
    """All elements, for any number of nodes and points, and selected columns."""
    fem, _ = solver(element, tissue)
    problem, count = fem.problem, fem.space.count
    u = bent(problem, 4e-4)
    expected = stiffer(fem, u, 0)
    problem.begin(Cases(down(1e-3, 1e-3), np.zeros(2)))
    every, first = np.ones(count, bool), problem.device.upload(np.zeros(1), wp.int32)
    place = problem.device.upload(np.arange(count)[:, None], wp.int32)
    out = wp.zeros((1, 3 * count, 3 * count), dtype=wp.float64, device="cpu")
    terms = [term for term in problem.terms if isinstance(term, StrainTerm)]
    assert terms
    for term in terms:
        some = problem.device.upload(term.find_elements_on(every), wp.int32)
        term.add_stiffening(some, u, first, problem.device.allocate(1), place, out)
    np.testing.assert_allclose(out.numpy()[0], expected, atol=1e-9 * np.abs(expected).max())


def test_node_strain_is_maximum_over_its_elements() -> None:
    """Elements whose nodes are all selected."""
    fem, _ = solver()
    problem, table = fem.problem, fem.space.table
    u = bent(problem, 4e-4)
    moved = u.numpy()[:, 0].reshape(-1, 3)[table]
    corners = fem.space.nodes[table]
    H = np.linalg.solve(corners[:, 1:] - corners[:, :1], moved[:, 1:] - moved[:, :1])
    size = np.linalg.norm(H, axis=(1, 2))
    nodes = np.zeros(fem.space.count, bool)
    nodes[: fem.space.count // 2] = True
    inside = nodes[table].all(axis=1)
    expected = np.zeros(fem.space.count)
    np.maximum.at(expected, table[inside].ravel(), np.repeat(size[inside], 4))
    found = problem.device.allocate(fem.space.count, 1)
    for term in problem.terms:
        if isinstance(term, StrainTerm):
            some = problem.device.upload(term.find_elements_on(nodes), wp.int32)
            term.update_max_strain(some, u, problem.device.upload(np.zeros(1), wp.int32), found)
    assert expected.max() > 0.1
    np.testing.assert_allclose(found.numpy()[:, 0], expected, rtol=1e-9)


def find_model(strains: StrainLimits) -> tuple[Fem, ContactDescent, wp.array, StrainedModel]:
    """Of two columns that are bent."""
    fem, descent = solver(strains=strains)
    u = bent(fem.problem, 4e-4)
    part = StrainedPart(fem.problem, descent.compliance, len(descent.barrier.touchable_nodes), strains)
    model = part.build_model(u, BOTH)
    assert model is not None
    return fem, descent, u, model


def test_updated_inverse_agrees_with_strained_stiffness() -> None:
    """H + H E M E' H, against K0 + D over the free motions; and its change between the touched nodes."""
    fem, descent, u, model = find_model(EVERY)
    problem, basis = fem.problem, fem.problem.constraint.build_basis()
    force = np.random.default_rng(4).normal(size=(problem.rows, 2))
    rest = descent.compliance.apply(force)
    near = rest[descent.compliance.rows]
    own = np.zeros_like(force)
    own[descent.compliance.rows] = model.apply_stiffness(problem.device, problem.device.upload(near)).numpy()
    found = rest + descent.compliance.apply(own)
    touched = descent.compliance.rows[: 3 * len(descent.barrier.touchable_nodes)]
    for column in range(2):
        whole = problem.rest_curvature().toarray() + stiffer(fem, u, column)
        inverse = basis @ np.linalg.solve(basis.T @ whole @ basis, basis.T.toarray())
        expected = inverse @ force[:, column]
        np.testing.assert_allclose(found[:, column], expected, atol=2e-5 * np.abs(expected).max())
        at_rest = descent.compliance.build_matrix(np.ones(len(descent.compliance.nodes), bool))[: len(touched)]
        now = at_rest[:, : len(touched)] + model.change[column, :-1, :-1]
        np.testing.assert_allclose(now, inverse[np.ix_(touched, touched)], atol=2e-5 * np.abs(inverse).max())


def test_update_selects_the_most_strained_nodes() -> None:
    """The number is limited, and no node with small strain is selected."""
    fem, descent, u, model = find_model(StrainLimits(min_strain=0.08, max_nodes=20))
    strain = fem.problem.device.allocate(fem.space.count, 2)
    every, columns = np.ones(fem.space.count, bool), fem.problem.device.upload(BOTH, wp.int32)
    for term in fem.problem.terms:
        if isinstance(term, StrainTerm):
            some = fem.problem.device.upload(term.find_elements_on(every), wp.int32)
            term.update_max_strain(some, u, columns, strain)
    assert model.nodes.shape[1] <= 20
    for column in range(2):
        own = model.matrix[column].any(axis=1).reshape(-1, 3).any(axis=1)
        chosen = descent.compliance.nodes[model.nodes[column][own]]
        others = np.setdiff1d(np.arange(fem.space.count), chosen)
        assert len(chosen) >= (10 if column == 0 else 0)
        if len(chosen):
            assert strain.numpy()[chosen, column].min() > max(0.08, 0.97 * strain.numpy()[others, column].max())


def test_updates_of_different_width_are_merged() -> None:
    _, _, _, narrow = find_model(StrainLimits(min_strain=0.08, max_nodes=20))
    _, _, _, wide = find_model(EVERY)
    both = narrow.merge_columns(np.array([1]), wide.select(np.array([0])))
    size = narrow.matrix.shape[1]
    np.testing.assert_array_equal(both.matrix[0, :size, :size], narrow.matrix[0])
    assert not both.matrix[0, size:].any() and not both.matrix[0, :, size:].any()
    np.testing.assert_array_equal(both.matrix[1], wide.matrix[0])
    np.testing.assert_array_equal(both.change[1], wide.change[0])
    both.reset_columns(np.array([1]))
    assert both.is_strained.tolist() == [True, False] and not both.change[1].any()


def test_deep_poses_take_fewer_steps_to_same_result() -> None:
    """Compared with the rest stiffness: a ball moves down step by step, each from the previous result."""
    ends, steps = [], []
    for strains in (STRAIN_LIMITS, StrainLimits(min_strain=np.inf)):
        fem, _ = solver("smoothed", "plain", strains, 1e-3)
        answers = [fem.deform(down(1e-3))]
        for depth in np.arange(2, 9) * 1e-3:
            answers.append(fem.deform(down(depth), answers[-1]))
        assert all(answer.outcome[0].good for answer in answers)
        steps.append(sum(int(answer.iterations[0]) for answer in answers))
        ends.append(answers[-1].displacement)
    assert steps[0] < 0.85 * steps[1]
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3 * np.abs(ends[1]).max())
