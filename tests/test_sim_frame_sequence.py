"""Frames that stay on the device: equal results for starts on device and host, and no loss of readable data."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box

from sim.accuracy import LIVE, Accuracy
from sim.deformation import Deformation, Outcome, build_start
from sim.discretisation.space import discretise
from sim.effects import Elasticity, Held, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, push, stack
from sim.minimisers.lbfgs import HISTORY_KEYS
from sim.strategy import frame_sequence
from sim.strategy.captured_frame import MAX_FRAME_EVALUATIONS
from sim.strategy.frame_sequence import DeviceWarmStart
from sim.strategy.plan import can_capture

BODY = make_box(cells=(6, 6, 3), spacing=12e-3, tumour=15e-3, depth=20e-3, opening=40e-3)
EFFECTS = (Elasticity(), Held(), ToolForce())


def follower(accuracy: Accuracy = LIVE) -> Fem:
    """On the CPU, which by itself would not follow."""
    fem = Fem(BODY, EFFECTS, accuracy, "cpu", element="p1")
    assert not fem.plan.captures_frames
    fem.strategy = replace(fem.strategy, plan=replace(fem.plan, captures_frames=True))
    return fem


@pytest.fixture(scope="module")
def fem() -> Fem:
    return follower()


def pushed(x: float, force: float = 0.4) -> Loads:
    return push(np.array([x, -1e-3, 0.0]), np.array([0.0, 0.05, -force]), 8e-3)


def ride(fem: Fem, count: int = 6) -> list[Deformation]:
    answers = [fem.deform(pushed(0.0))]
    for number in range(1, count):
        answers.append(fem.deform(pushed(7e-4 * number), answers[-1]))
    return answers


def same(one: Deformation, other: Deformation) -> bool:
    assert set(one.warm) == set(other.warm)
    names = ("displacement", "iterations", "residual", "reaction", "reached", "inverted", "time", "nodes")
    pairs = [(getattr(one, name), getattr(other, name)) for name in names]
    pairs += [(one.warm[name], other.warm[name]) for name in one.warm]
    return one.outcome == other.outcome and all(np.array_equal(*pair) for pair in pairs)


def test_frame_sequence_agrees_with_standard_solver(fem):
    plain = Fem(BODY, EFFECTS, LIVE, "cpu", element="p1")
    for own, other in zip(ride(fem)[1:], ride(plain)[1:], strict=True):
        assert isinstance(own.warm, DeviceWarmStart) and own.outcome == other.outcome == (Outcome.CONVERGED,)
        assert own.iterations[0] == other.iterations[0]
        np.testing.assert_allclose(own.displacement, other.displacement, atol=1e-4 * np.abs(other.displacement).max())
        np.testing.assert_allclose(own.reaction, other.reaction, rtol=1e-9, atol=1e-12)
        assert own.residual[0] == pytest.approx(other.residual[0], rel=0.02) and own.residual[0] <= LIVE.tolerance
        assert set(own.warm) == set(other.warm)
        assert own.warm["known"].shape == (1,)


def test_start_on_device_and_on_host_give_same_result(fem):
    last = ride(fem)[-1]
    here = fem.deform(pushed(5e-3), last)
    brought = fem.deform(pushed(5e-3), replace(last, warm={**last.warm}))
    assert same(here, brought)


def test_older_frame_as_start_gives_its_former_result(fem):
    answers = ride(fem)
    again = fem.deform(pushed(7e-4 * 3), answers[2])
    assert same(again, answers[3])
    assert same(fem.deform(pushed(7e-4 * 5), answers[4]), answers[5])
    assert same(fem.deform(pushed(7e-4 * 4), again), answers[4])


def test_only_kept_frames_are_copied_from_the_device(fem, monkeypatch):
    read = []
    monkeypatch.setattr(frame_sequence, "to_rows_first", lambda array: read.append(array) or array.numpy().copy())
    last = ride(fem, 3)[-1]
    read.clear()
    for number in range(5):
        last = fem.deform(pushed(2e-3 + 5e-4 * number), last)
    assert not read
    kept = last
    for number in range(3):
        last = fem.deform(pushed(5e-3 + 5e-4 * number), last)
    assert len(read) == len(HISTORY_KEYS) and kept.warm["s"].any()
    assert len(read) == len(HISTORY_KEYS)


def test_batch_between_frames_does_not_change_the_result(fem):
    answers = ride(fem)
    other = ride(fem, 5)[-1]
    fem.deform(stack([pushed(x) for x in (0.0, 4e-3, 8e-3)]))
    assert same(fem.deform(pushed(7e-4 * 5), other), answers[-1])


def test_frame_that_fails_is_solved_by_standard_solver(fem):
    last = ride(fem)[-1]
    with pytest.raises(InputError, match="does not touch the surface"):
        fem.deform(pushed(0.5), last)
    lifted = fem.deform(pushed(4e-3, 0.0).scale(np.zeros(1)), last)
    assert not lifted.displacement.any() and not isinstance(lifted.warm, DeviceWarmStart)
    assert isinstance(fem.deform(pushed(4e-3), lifted).warm, DeviceWarmStart)
    vast = fem.deform(pushed(4e-3, 60.0), last)
    assert not isinstance(vast.warm, DeviceWarmStart)
    assert same(fem.deform(pushed(4e-3), last), fem.deform(pushed(4e-3), replace(last)))


def test_unsuitable_start_is_solved_by_standard_solver(fem):
    rng, good = np.random.default_rng(0), ride(fem, 2)[-1]
    torn = fem.deform(pushed(1e-3), build_start(good.displacement + rng.normal(0.0, 0.1, good.displacement.shape)))
    assert torn.outcome == (Outcome.CONVERGED_ANEW,)
    loose = good.displacement.copy()
    loose[0, BODY.fixed.any(axis=1)] += 1e-4
    assert not isinstance(fem.deform(pushed(1e-3), build_start(loose)).warm, DeviceWarmStart)
    assert isinstance(fem.deform(pushed(1e-3), build_start(good.displacement)).warm, DeviceWarmStart)


def test_start_may_list_its_vertices_in_any_order(fem):
    last = ride(fem)[-1]
    turned = last.restrict(last.nodes[::-1].copy())
    assert same(fem.deform(pushed(5e-3), last), fem.deform(pushed(5e-3), turned))


def test_displacement_of_kept_frame_is_read_only(fem):
    with pytest.raises(ValueError, match="read-only"):
        ride(fem)[-1].displacement[0, 0] = 1.0


def test_frame_at_selected_vertices_agrees_with_whole_frame(fem):
    last, some = ride(fem)[-1], np.array([40, 3, 7])
    picked = fem.deform(pushed(5e-3), last, at=some)
    np.testing.assert_array_equal(picked.displacement, fem.deform(pushed(5e-3), last).displacement[:, some])


def test_frame_sequence_requires_linear_elements_and_budget():
    linear, quadratic = (discretise(BODY.mesh, element) for element in ("p1", "p2"))
    assert can_capture(linear, LIVE) and MAX_FRAME_EVALUATIONS > 20
    assert not can_capture(linear, replace(LIVE, outer=5)) and not can_capture(quadratic, LIVE)
