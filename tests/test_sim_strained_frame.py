"""Frames on the device with the stiffness of strained tissue: same steps and results for every kind of start."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from conftest import make_box
from test_sim_frame_sequence import EFFECTS, same

from sim.accuracy import LIVE
from sim.deformation import Deformation, Outcome
from sim.discretisation.term import Cases
from sim.fem import Fem
from sim.linalg.multifrontal import SparseFactor
from sim.loads import Loads, push
from sim.local_solvers.strained_descent import (
    SINGLE_LIMITS,
    Renewal,
    StiffenedPreconditioner,
    StrainedDescent,
    build_strained_part,
)
from sim.local_solvers.strained_frame import MATRIX_KEY, NODES_KEY, UpdatedPreconditioner, compute_updated_model
from sim.strategy.captured_frame import MAX_SERVED_STEPS
from sim.strategy.frame_sequence import DeviceWarmStart

BODY = make_box(cells=(6, 6, 3), spacing=12e-3, tumour=15e-3, depth=20e-3, opening=40e-3)


def follower(strained: bool) -> Fem:
    """On the CPU, which by itself would not follow."""
    fem = Fem(BODY, EFFECTS, replace(LIVE, limit_strain=False), "cpu", element="smoothed")
    fem.strategy = replace(fem.strategy, plan=replace(fem.plan, captures_frames=True, updates_model=strained))
    return fem


@pytest.fixture(scope="module")
def fem() -> Fem:
    return follower(True)


def pressed(number: float) -> Loads:
    return push(np.array([7e-4 * number, -1e-3, 0.0]), np.array([0.0, 0.2, -1.6]), 8e-3)


def ride(fem: Fem, count: int = 7) -> list[Deformation]:
    answers = [fem.deform(pressed(0))]
    for number in range(1, count):
        answers.append(fem.deform(pressed(number), answers[-1]))
    return answers


def test_strained_frames_take_fewer_steps_to_same_result(fem: Fem) -> None:
    own, plain = ride(fem), ride(follower(False))
    for one, other in zip(own[1:], plain[1:], strict=True):
        assert isinstance(one.warm, DeviceWarmStart) and one.outcome == other.outcome == (Outcome.CONVERGED,)
        assert one.residual[0] <= LIVE.tolerance
        size = np.abs(other.displacement).max()
        np.testing.assert_allclose(one.displacement, other.displacement, atol=5e-3 * size)
    # The first that follows comes from a solver that left no model.
    assert own[1].iterations[0] == plain[1].iterations[0] > MAX_SERVED_STEPS
    assert sum(int(one.iterations[0]) for one in own[2:]) <= 0.6 * sum(int(one.iterations[0]) for one in plain[2:])


def test_update_is_renewed_only_after_slow_frames(fem: Fem) -> None:
    answers = ride(fem)[1:]
    models = [answer.warm.bent for answer in answers if isinstance(answer.warm, DeviceWarmStart)]
    assert models[0] is not None
    anew = [after is not before for before, after in pairwise(models)]
    assert anew == [int(answer.iterations[0]) > MAX_SERVED_STEPS for answer in answers[1:]]
    assert not all(anew)


def test_start_on_device_and_on_host_give_same_result(fem: Fem) -> None:
    last = ride(fem)[-1]
    here = fem.deform(pressed(7), last)
    brought = fem.deform(pressed(7), replace(last, warm={**last.warm}))
    assert {NODES_KEY, MATRIX_KEY} <= set(here.warm) and same(here, brought)


def test_older_frame_as_start_gives_its_former_result(fem: Fem) -> None:
    answers = ride(fem)
    assert same(fem.deform(pressed(3), answers[2]), answers[3])
    assert same(fem.deform(pressed(6), answers[5]), answers[6])


@pytest.mark.parametrize("fault", ["missing", "short", "far", "negative", "nan", "kind"])
def test_inconsistent_update_of_a_frame_is_ignored(fem: Fem, fault: str) -> None:
    last = ride(fem)[-1]
    warm = dict(last.warm)
    plain = {name: warm[name] for name in warm if name not in (NODES_KEY, MATRIX_KEY)}
    none = fem.deform(pressed(7), replace(last, warm=plain))
    match fault:
        case "missing":
            del warm[MATRIX_KEY]
        case "short":
            warm[NODES_KEY] = warm[NODES_KEY][:, 1:]
        case "far":
            warm[NODES_KEY] = warm[NODES_KEY] + fem.problem.rows // 3
        case "negative":
            warm[NODES_KEY] = warm[NODES_KEY] - fem.problem.rows // 3
        case "nan":
            warm[MATRIX_KEY] = np.full_like(warm[MATRIX_KEY], np.nan)
        case _:
            warm[NODES_KEY] = warm[NODES_KEY].astype(float)
    assert same(fem.deform(pressed(7), replace(last, warm=warm)), none)


def test_update_matrix_agrees_with_update_by_factors(fem: Fem) -> None:
    """The update of live loads on the CPU is tested against the inverse itself."""
    problem, factor = fem.problem, fem.strategy.preconditioner
    assert isinstance(factor, SparseFactor)
    last = ride(fem)[-1]
    u = problem.device.upload(fem.guess(pressed(6), last))
    part = build_strained_part(problem, factor, fem.space, SINGLE_LIMITS)
    part.prepare()
    bent = compute_updated_model(part, problem.device, u)
    problem.begin(Cases(pressed(6.5), np.zeros(1)))
    single = StrainedDescent(problem, factor, part, Renewal(max_reused_steps=8)).descend(u, np.full(1, 1e-2), 8, {})
    assert bent is not None and set(single.warm_start)
    force = np.zeros((problem.rows, 1))
    force[-30:] = np.random.default_rng(1).normal(size=(30, 1))
    g = problem.device.upload(force)
    problem.constraint.project_nodes(g)
    mine, plain, other = (problem.device.allocate(problem.rows, 1) for _ in range(3))
    knowing = UpdatedPreconditioner(factor, problem, part.size)
    knowing.apply(g, np.ones(1, bool), plain)
    knowing.load_model(bent)
    knowing.apply(g, np.ones(1, bool), mine)
    stiffened = StiffenedPreconditioner(factor, problem)
    stiffened.stiffening = StrainedDescent(problem, factor, part).get_warm_start(single.warm_start)
    stiffened.apply(g, np.ones(1, bool), other)
    size = np.abs(other.numpy()).max()
    np.testing.assert_allclose(mine.numpy(), other.numpy(), atol=2e-3 * size)
    assert np.abs(plain.numpy() - other.numpy()).max() > 0.05 * size
    knowing.load_model(None)
    knowing.apply(g, np.ones(1, bool), mine)
    np.testing.assert_array_equal(mine.numpy(), plain.numpy())
