"""Results of threads that share a deformer equal those of a single thread."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from boxes import base_held, box

from sim.accuracy import LIVE, REFERENCE, Accuracy
from sim.deformation import Deformation
from sim.effects import Elasticity, Held, NodalForce, Resection, ToolForce
from sim.fem import Fem
from sim.loads import Loads, Resected, push
from sim.resected_fem import build_fem
from sim.strategy.frame_sequence import DeviceWarmStart

BODY = base_held(box((4, 4, 4), 0.1))
EFFECTS = Elasticity(), Held(), ToolForce(), NodalForce()
PLACES = np.array([[0.03, 0.05, 0.1], [0.05, 0.04, 0.1], [0.06, 0.06, 0.1], [0.04, 0.07, 0.1]])
THREADS = len(PLACES)
T = TypeVar("T")


def pushes(thread: int) -> list[Loads]:
    """One thread's: single ones, and a batch in other forces."""
    force = np.array([[0.0, 0.05, -0.2], [0.1, 0.0, -0.4], [0.0, 0.0, 0.3]]) * (1.0 + 0.2 * thread)
    whole = push(PLACES[thread], force, 0.02)
    return [whole.select(slice(0, 1)), whole, whole.select(slice(2, 3))]


def same(one: Deformation, other: Deformation) -> None:
    for name in ("displacement", "reaction", "residual", "iterations"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert set(one.memory) == set(other.memory)


def together_and_alone(work: Callable[[int], list[T]]) -> list[tuple[T, T]]:
    """Each result of threads that all begin together, with that of the thread's work alone."""
    alone, ready = [work(thread) for thread in range(THREADS)], threading.Barrier(THREADS)

    def begin(thread: int) -> list[T]:
        ready.wait()
        return work(thread)

    with ThreadPoolExecutor(THREADS) as pool:
        found = pool.map(begin, range(THREADS))
        return [pair for theirs, own in zip(found, alone, strict=True) for pair in zip(theirs, own, strict=True)]


@pytest.mark.parametrize("accuracy", [LIVE, REFERENCE], ids=["float32", "float64"])
def test_finite_elements_shared_by_threads_are_bit_identical(accuracy: Accuracy) -> None:
    """Cold and warm: warm data are part of the results, not of the solver."""
    fem = Fem(BODY, EFFECTS, accuracy, "cpu", batch=2, element="p1")

    def work(thread: int) -> list[Deformation]:
        answers = [fem.deform(loads) for loads in pushes(thread)]
        warm = [fem.deform(loads.scale(1.1), start) for loads, start in zip(pushes(thread), answers, strict=True)]
        return answers + warm

    for one, other in together_and_alone(work):
        same(one, other)


def test_residuals_and_series_shared_by_threads_are_identical() -> None:
    fem = Fem(BODY, EFFECTS, REFERENCE, "cpu", batch=2, element="p1")
    nodes = np.arange(40, 46)
    modes = np.eye(18).reshape(18, 6, 3)

    def work(thread: int) -> list[np.ndarray]:
        loads = pushes(thread)[1]
        found = fem.deform(loads.scale(0.7))
        series = fem.compute_series(loads, 2, fem.build_reading(nodes, modes))
        return [fem.residual(loads, found), series]

    for one, other in together_and_alone(work):
        np.testing.assert_array_equal(one, other)


def test_resected_body_shared_by_threads_is_bit_identical() -> None:
    gone = np.flatnonzero((BODY.mesh.nodes[BODY.mesh.tets].mean(axis=1) > [0.0, 0.0, 0.075]).all(axis=1))[:9]
    fem = build_fem(BODY, (*EFFECTS, Resection((tuple(gone.tolist()),))), LIVE, "cpu")

    def work(thread: int) -> list[Deformation]:
        loads = pushes(thread)[1]
        done = Resected(np.arange(len(loads)) % 2)
        return [fem.deform(Loads((*loads.causes, done)))]

    for one, other in together_and_alone(work):
        same(one, other)


def test_results_on_device_are_kept_after_later_solves() -> None:
    """Frame after frame, each thread on its own path; warm data are read after others have moved on."""
    fem = Fem(BODY, (Elasticity(), Held(), ToolForce()), LIVE, "cpu", element="p1")
    fem.strategy = replace(fem.strategy, plan=replace(fem.plan, captures_frames=True))

    def work(thread: int) -> list[Deformation]:
        point, force = PLACES[thread], np.array([0.0, 0.05, -0.3])
        answers = [fem.deform(push(point, force, 0.02))]
        for number in range(1, 5):
            answers.append(fem.deform(push(point + [1e-3 * number, 0.0, 0.0], force, 0.02), answers[-1]))
            if number % 2:
                dict(answers[-1].warm)
        return answers

    found = together_and_alone(work)
    assert isinstance(found[-1][1].warm, DeviceWarmStart)
    for one, other in found:
        same(one, other)
        assert all(np.array_equal(one.warm[name], other.warm[name]) for name in ("head", "known"))
