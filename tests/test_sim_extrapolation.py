"""Start of a frame by extrapolation of the last two: exact on a straight path, limited by the change of the load."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import make_box

from sim.accuracy import LIVE
from sim.deformation import build_start
from sim.effects import Elasticity, Held, ToolForce
from sim.fem import Fem
from sim.loads import Loads, push
from sim.strategy.extrapolation import BEFORE_KEY, PUSHES_KEY, as_pushes, compute_factors, extrapolate_start

EFFECTS = (Elasticity(), Held(), ToolForce())
POINT, DOWN = np.array([2e-3, -1e-3, 0.0]), np.array([0.0, 0.0, -0.2])


@pytest.fixture(scope="module")
def body():
    return make_box(cells=(6, 6, 3), spacing=12e-3, tumour=15e-3, depth=20e-3, opening=40e-3)


def pushed(x: float, force: float = 1.0, y: float = 0.0) -> Loads:
    return push(POINT + [x, y, 0.0], force * DOWN, 8e-3)


def forgetting(warm: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in warm.items() if name != BEFORE_KEY}


def build_row(load: Loads) -> np.ndarray:
    row = as_pushes(load)
    assert row is not None
    return row


def share_of(now: Loads, last: Loads, before: Loads) -> float:
    return compute_factors(build_row(now), build_row(last), build_row(before))[0]


def test_extrapolation_share_follows_the_load():
    before, last = pushed(0.0), pushed(1e-3)
    assert share_of(pushed(2e-3), last, before) == pytest.approx(1.0)
    assert share_of(pushed(1.5e-3), last, before) == pytest.approx(0.5)
    assert share_of(last, last, before) == 0.0
    assert share_of(pushed(1e-3, y=2e-3), last, before) == pytest.approx(0.0)
    assert share_of(before, last, before) == pytest.approx(-1.0)
    assert share_of(pushed(-9e-3), last, before) == -1.0
    assert share_of(pushed(9e-3), last, before) == 2.0
    assert share_of(pushed(0.0, 1.2), pushed(0.0, 1.1), pushed(0.0)) == pytest.approx(1.0)


def test_still_or_lifted_tool_gives_no_extrapolation():
    assert share_of(pushed(1e-3), pushed(0.0), pushed(0.0)) == 0.0
    for lifted in range(3):
        loads = [pushed(2e-3), pushed(1e-3), pushed(0.0)]
        loads[lifted] = pushed(1e-3 * (2 - lifted), 0.0)
        assert share_of(*loads) == 0.0


def test_extrapolation_is_linear_for_each_load():
    last, before = np.random.default_rng(0).normal(size=(2, 12, 2))
    pushes = np.stack([np.concatenate([build_row(pushed(x)) for x in (1e-3, 0.0)]).reshape(2, 7)] * 2)
    warm = {PUSHES_KEY: pushes, BEFORE_KEY: before.T}
    loads = push(np.array([POINT + [2e-3, 0.0, 0.0], POINT + [1e-3, 0.0, 0.0]]), np.array([DOWN, DOWN]), 8e-3)
    start = extrapolate_start(loads, last, warm)
    np.testing.assert_allclose(start, np.column_stack([2.0 * last[:, 0] - before[:, 0], last[:, 1]]), atol=1e-12)
    assert extrapolate_start(loads, last, {}) is last
    assert extrapolate_start(loads, last, warm | {BEFORE_KEY: before.T[:, :9]}) is last  # another element's


def test_extrapolation_reduces_steps_of_moving_tool_frames(body):
    fem = Fem(body, EFFECTS, LIVE, "cpu", element="p1")
    exact = Fem(body, EFFECTS, replace(LIVE, tolerance=1e-4), "cpu", element="p1")
    steps, last, plain = np.zeros(2, int), None, None
    for x in np.linspace(0.0, 10e-3, 12):
        load = pushed(x, 2.0)
        last = fem.deform(load, last)
        plain = fem.deform(load, plain and replace(plain, warm=forgetting(plain.warm)))
        steps += last.iterations[0], plain.iterations[0]
        truth = exact.deform(load).displacement
        assert np.abs(last.displacement - truth).max() <= 0.03 * np.abs(truth).max()
    assert steps[0] < 0.9 * steps[1]


def test_extrapolation_to_inverted_elements_is_discarded(body):
    fem = Fem(body, EFFECTS, LIVE, "cpu", element="p1")
    first = fem.deform(pushed(0.0))
    last = fem.deform(pushed(1e-3), first)
    torn = last.warm[BEFORE_KEY] + np.random.default_rng(1).normal(0.0, 0.1, last.warm[BEFORE_KEY].shape)
    answer = fem.deform(pushed(2e-3), replace(last, warm={**last.warm, BEFORE_KEY: torn}))
    assert answer.outcome[0].name == "CONVERGED" and answer.inverted[0] == 0


def test_guessed_start_gives_no_extrapolation(body):
    fem = Fem(body, EFFECTS, LIVE, "cpu", element="p1")
    first = fem.deform(pushed(0.0))
    assert BEFORE_KEY not in first.warm
    second = fem.deform(pushed(1e-3), build_start(first.displacement))
    assert BEFORE_KEY not in second.warm
    np.testing.assert_allclose(fem.deform(pushed(2e-3), second).warm[BEFORE_KEY][0], second.displacement.ravel())


@pytest.mark.parametrize("spoilt", [PUSHES_KEY, "s", "known", "head"])
def test_inconsistent_history_of_pushes_is_ignored(body, spoilt):
    fem = Fem(body, EFFECTS, LIVE, "cpu", element="p1")
    last = fem.deform(pushed(1e-3), fem.deform(pushed(0.0)))
    lacking = {name: value for name, value in last.warm.items() if name != spoilt}
    strange = {**last.warm, spoilt: 99 * np.ones((1, 3), int)}
    bare = fem.deform(pushed(2e-3), replace(last, warm={}))
    for warm in (lacking, strange):
        answer = fem.deform(pushed(2e-3), replace(last, warm=warm))
        assert answer.outcome[0].good
        np.testing.assert_allclose(answer.displacement, bare.displacement, atol=2e-5)
