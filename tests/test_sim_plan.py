"""Solvers that are selected for a load: the table, and the solvers that run."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import base_held, box
from conftest import make_box
from openings import EFFECTS, TOTAL, body, loads_of

from sim.accuracy import TRAIN, Accuracy
from sim.effects import Effect, Elasticity, Held, Inertia, Retraction, ToolContact, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.local_solvers.batch_elimination import BatchElimination
from sim.local_solvers.clamped_elimination import ClampedElimination
from sim.local_solvers.strained_descent import StrainedDescent
from sim.minimisers.lbfgs import Lbfgs
from sim.strategy import strategy
from sim.strategy.plan import PLAN_LIMITS, SolverPlan, SolverStep
from sim.terms.elasticity import ElasticTerm
from sim.tools import Ball, Spatula

BODY, PUSHED = body()[0], (Elasticity(), *EFFECTS)
WIDE = {"anatomy": base_held(box((3, 3, 3), 0.1)), "effects": (Elasticity(), Held(), ToolForce())}
POSED = {"anatomy": make_box(), "effects": (Elasticity(), Held(), ToolContact((Ball(7e-3),)))}
LAST = (SolverStep.LBFGS, SolverStep.NEWTON)
MANY = PLAN_LIMITS.min_shared_cases


def planned(anatomy=BODY, effects: tuple[Effect, ...] = PUSHED, accuracy: Accuracy = TRAIN, **more) -> SolverPlan:
    return Fem(anatomy, effects, accuracy, "cpu", **{"element": "p1", **more}).plan


@pytest.mark.parametrize(
    ("more", "one", "few", "many"),
    [
        ({}, LAST, LAST, (SolverStep.NEAR, *LAST)),
        ({"element": "smoothed"}, LAST, LAST, (SolverStep.NEAR, *LAST)),
        ({"live": True}, LAST, LAST, (SolverStep.NEAR, *LAST)),
        ({"element": "smoothed", "live": True}, (SolverStep.STRAINED, *LAST), LAST, (SolverStep.NEAR, *LAST)),
        ({"element": "p2"}, (SolverStep.CLAMPED, *LAST), LAST, LAST),
        ({"element": "p2", "live": True}, (SolverStep.CLAMPED, *LAST), LAST, LAST),
        ({**WIDE, "live": True}, LAST, LAST, LAST),
        ({"effects": (*PUSHED, Inertia()), "live": True}, LAST, LAST, LAST),
        ({"accuracy": replace(TRAIN, outer=PLAN_LIMITS.min_outer_iterations - 1)}, *3 * [(SolverStep.NEWTON,)]),
        (POSED, *3 * [(SolverStep.NEWTON,)]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_planned_solver_steps_agree_with_the_table(more, one, few, many):
    plan = planned(**more)
    assert [plan.list_steps(count) for count in (1, 2, MANY)] == [one, few, many]
    assert plan.list_steps(MANY, imposed=True) == (SolverStep.NEWTON,) and not plan.captures_frames


def test_contact_descent_requires_exactly_one_tool_effect():
    assert planned(**POSED).contact_solver is SolverStep.CONTACT and planned().contact_solver is None
    both = (*POSED["effects"], Retraction(Spatula(12e-3, 20e-3, 1e-3)))
    assert planned(**{**POSED, "effects": both}).contact_solver is SolverStep.NEWTON


@pytest.mark.parametrize(
    ("avoid", "steps"),
    [
        (SolverStep.NEAR, {MANY: LAST}),
        (SolverStep.STRAINED, {1: LAST}),
        (SolverStep.LBFGS, {1: (SolverStep.NEWTON,), MANY: (SolverStep.NEWTON,)}),
        (SolverStep.NEWTON, {1: (SolverStep.STRAINED, *LAST), MANY: (SolverStep.NEAR, *LAST)}),
    ],
)
def test_avoided_solver_step_is_not_planned(avoid, steps):
    plan = planned(live=True, element="smoothed", avoid=(avoid,))
    assert {count: plan.list_steps(count) for count in steps} == steps
    assert planned(**POSED, avoid=(SolverStep.CONTACT,)).contact_solver is SolverStep.NEWTON
    assert planned(element="p2", avoid=(SolverStep.CLAMPED,)).single_solver is None


@pytest.mark.parametrize("evaluations", [0, 1, 7])
@pytest.mark.parametrize(
    ("count", "more"), [(1, {"live": True, "element": "smoothed"}), (MANY, {}), (1, {"element": "p2"})]
)
def test_evaluation_budget_bounds_work_before_newton(count, more, evaluations, monkeypatch):
    """Counted at the element's kernels of the whole body: the part of a local solver is another problem."""
    accuracy, looks = replace(TRAIN, evaluations=evaluations, outer=PLAN_LIMITS.min_outer_iterations, steps=0), []
    fem = Fem(BODY, PUSHED, accuracy, "cpu", **{"element": "p1", **more})
    whole = next(term for term in fem.problem.terms if isinstance(term, ElasticTerm))
    inside, found = ElasticTerm.add_gradient, strategy.find_equilibrium

    def looking(term, u, out):
        if term is whole:
            looks.append(u)
        inside(term, u, out)

    def newton(*given):
        before.append(len(looks))
        return found(*given)

    before = []
    monkeypatch.setattr(ElasticTerm, "add_gradient", looking)
    monkeypatch.setattr(strategy, "find_equilibrium", newton)
    fem.deform(loads_of(np.tile(TOTAL[3], (count, 1))))
    spent = before[0] if before else len(looks)
    # A solver that goes on judges its start, and a cycle may try twice.
    assert bool(spent) == bool(evaluations) and spent <= 2 * evaluations + 3
    assert before or evaluations > 1
    with pytest.raises(InputError, match="evaluations"):
        replace(TRAIN, evaluations=-1)


def test_quadratic_elements_use_batches_of_one():
    assert planned(element="p2", batch=8).batch == 1 and planned(batch=8).batch == 8


@pytest.mark.parametrize(
    ("count", "more"),
    [(1, {"live": True, "element": "smoothed"}), (2, {"live": True}), (MANY, {}), (1, {"element": "p2"})],
)
def test_solvers_run_in_the_order_of_the_plan(count, more, monkeypatch):
    """Each solver passes every load on, so that all are recorded."""
    tried, left = [], [PLAN_LIMITS.max_evaluations]
    kinds = {
        BatchElimination: SolverStep.NEAR,
        StrainedDescent: SolverStep.STRAINED,
        ClampedElimination: SolverStep.CLAMPED,
        Lbfgs: SolverStep.LBFGS,
    }

    def deaf(kind):
        original = kind.descend

        def descend(self, start, tolerance, most, *rest, **named):
            if kind is Lbfgs and self is not fem.strategy.lbfgs:  # that of a part
                return original(self, start, tolerance, most, *rest, **named)
            assert most == left[-1]
            tried.append(kinds[kind])
            found = original(self, start, np.full(start.shape[1], 1e-30), 1, *rest, **named)
            left.append(most - found.steps.max())
            return found

        return descend

    def newton(*given):
        tried.append(SolverStep.NEWTON)
        return found(*given)

    fem, found = Fem(BODY, PUSHED, TRAIN, "cpu", **{"element": "p1", **more}), strategy.find_equilibrium
    for kind in kinds:
        monkeypatch.setattr(kind, "descend", deaf(kind))
    monkeypatch.setattr(strategy, "find_equilibrium", newton)
    answer = fem.deform(loads_of(np.tile(TOTAL[1], (count, 1))))
    assert all(outcome.good for outcome in answer.outcome)
    assert tuple(tried) == fem.plan.list_steps(count)


@pytest.mark.parametrize(
    ("more", "said", "unsaid"),
    [
        (
            {},
            (
                f"Batches of {MANY} loads and more",
                "L-BFGS",
                f"at most {PLAN_LIMITS.max_evaluations} evaluations",
                "sparse factor",
            ),
            ("A single load",),
        ),
        (
            {"live": True, "element": "smoothed"},
            ("A single load begins with L-BFGS from a stiffness that is updated at the few hundred nodes",),
            ("moved by pose",),
        ),
        (
            {"element": "p2"},
            ("clamped at its boundary", "One load is solved at a time", "multigrid"),
            ("loads and more",),
        ),
        (
            {"accuracy": replace(TRAIN, outer=3, steps=0)},
            ("Every load is solved by Newton-CG",),
            ("L-BFGS", "load steps"),
        ),
        (POSED, ("moved by pose", "proximal"), ("L-BFGS from",)),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_plan_explanation_describes_the_solvers(more, said, unsaid):
    lines = planned(**more).explain()
    text = " ".join(lines)
    assert all(line[0].isupper() and line.endswith(".") and len(line.split()) < 32 for line in lines), lines
    assert all(words in text for words in said), text
    assert not any(words in text for words in unsaid), text
