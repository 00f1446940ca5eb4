"""Tasks on several threads: all done, errors raised where they are waited for."""

import threading

import numpy as np
import pytest
from boxes import base_held, box
from oracle import tissue

from sim.compile import compile_problem
from sim.effects import Elasticity, Held
from sim.linalg.preconditioner import rest_solver
from sim.runtime.device import find_device
from sim.runtime.threads import Sharing, cores, together


def test_every_task_is_done_when_it_returns():
    done: list[int] = []
    for _ in range(50):
        together([lambda number=number: done.append(number) for number in range(3)])
    assert sorted(done) == sorted([0, 1, 2] * 50)


def test_tasks_run_at_the_same_time():
    meeting = threading.Barrier(2, timeout=5.0)
    together([meeting.wait, meeting.wait])


@pytest.mark.parametrize("bad", [0, 1])
def test_errors_come_out_and_the_threads_stay(bad: int):
    def fail():
        raise ValueError("no")

    done: list[int] = []
    tasks = [lambda: done.append(1), lambda: done.append(1)]
    tasks[bad] = fail
    with pytest.raises(ValueError, match="no"):
        together(tasks)
    assert done == [1]
    together([lambda: done.append(2)] * 2)
    assert done == [1, 2, 2]


def test_one_core_at_least_and_one_for_little() -> None:
    assert cores(10**6) >= 1
    assert cores(Sharing().least - 1) == 1
    assert cores(10**6, Sharing(most=1)) == 1


def test_two_cores_find_what_one_does(monkeypatch: pytest.MonkeyPatch) -> None:
    device, mesh = find_device("cpu", "float64"), box((4, 4, 4), 0.1, distortion=0.1)
    u = device.array(np.random.default_rng(0).normal(size=(mesh.nodes.size, 3)) * 1e-3)
    found = []
    for number in (1, 2):
        for place in ("sim.terms.elasticity.cores", "sim.linalg.multifrontal.cores"):
            monkeypatch.setattr(place, lambda work, number=number: number)
        problem = compile_problem((Elasticity(tissue("neo-hookean")), Held()), base_held(mesh), device)
        g, _, _ = problem.residual(u)
        z = device.zeros(*u.shape)
        rest_solver(problem).apply(g, np.ones(3, bool), z)
        found.append((g.numpy().copy(), problem.longest_step(u, g), z.numpy().copy()))
    for one, two in zip(*found, strict=True):
        np.testing.assert_allclose(two, one, atol=1e-11 * np.abs(one).max())
