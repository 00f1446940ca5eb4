"""Rows of a report whose tool is moved instead of pushed."""

from dataclasses import replace

import numpy as np
import pytest
from studies import TISSUE, solved

from scenes.report.finite_elements import FemVariant, measure_elements
from scenes.report.pose import compute_motion, find_field_of_motion, measure_pose_error
from scenes.report.reference import get_reference
from sim.accuracy import TRAIN
from sim.effects import build_push_effects
from sim.fem import Fem
from sim.loads import Loads, Pushed

COMPLIANCE = np.array([[2.0, 0.3, 0.0], [0.3, 1.5, -0.2], [0.0, -0.2, 3.0]])


def solve_stiffening(rows, force):
    """Two vertices (n, 2, 3): the first moves by a stiffening spring, the second twice as far."""
    motion = np.einsum("ij,nj->ni", COMPLIANCE, force)
    motion /= (1.0 + np.linalg.norm(motion, axis=1, keepdims=True)) ** 0.3
    return np.stack([motion, 2.0 * motion], axis=1)


def test_forces_are_found_that_move_footprints_as_given():
    random = np.random.default_rng(0)
    force, weights = random.normal(size=(9, 3)), np.full((9, 2), 0.5)
    target = compute_motion(weights, solve_stiffening(None, 1.7 * force + 0.2 * random.normal(size=(9, 3))))
    good = np.arange(9) != 4
    field = find_field_of_motion(solve_stiffening, force, target, weights, good)
    assert good.sum() == 8 and not field[4].any()
    error = np.linalg.norm(compute_motion(weights, field) - target, axis=1)[good]
    assert (error <= 1e-3 * np.linalg.norm(target, axis=1)[good]).all()
    assert np.allclose(field[good, 1], 2.0 * field[good, 0])


def test_motion_that_no_force_gives_is_excluded():
    good = np.ones(3, bool)
    target = np.array([[0.1, 0.0, 0.0], [9.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    force = np.full((3, 3), 0.1)

    def solve(rows, force):
        return np.clip(solve_stiffening(rows, force), -1.0, 1.0)

    find_field_of_motion(solve, force, target, np.array([[1.0, 0.0]] * 3), good)
    assert good.tolist() == [True, False, False]


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_stiffness_of_body_is_irrelevant_if_tool_is_moved(study, factor):
    """A body of twice the stiffness moves half as far under a force, and as far under a tool that is moved."""
    body, (pushed,) = study.anatomy, study.test_loads.get_all(Pushed)
    fem = Fem(body, build_push_effects(body, replace(TISSUE, young=factor * TISSUE.young)), TRAIN, "cpu", element="p2")

    def solve(rows, force):
        loads = Loads((Pushed(pushed.point[rows], force, pushed.footprint[rows]),))
        return fem.deform(loads).displacement[:, study.read_nodes]

    tumour = np.isin(study.read_nodes, body.tumour_nodes)
    pushed_far = solve(np.arange(2), pushed.force)[:, tumour]
    ratio = np.linalg.norm(pushed_far, axis=2).mean() / (
        np.linalg.norm(get_reference(study).displacement[:, tumour], axis=2).mean()
    )
    assert ratio == pytest.approx(1.0 / factor, rel=0.1)
    found = measure_pose_error(study, solve)
    assert found.loads == 2 and found.percent.mean < 0.2


def test_only_thorough_reports_measure_moved_tools_and_batches(study):
    long, short = (measure_elements(each, FemVariant("FEM")) for each in (solved(replace(study, thorough=True)), study))
    assert long.pose.loads == 2 and 0.0 < long.pose.percent.mean < 100.0 and long.batch_ms > 0.0
    assert short.pose is None and short.batch_ms is None and short.reference.loads == 2
