"""Residual, step bound and preconditioner on several CPU threads."""

import numpy as np
import pytest
from boxes import base_held, box
from oracle import tissue

from sim.compile import compile_problem
from sim.effects import Elasticity, Held
from sim.linalg.preconditioner import build_rest_solver
from sim.runtime.device import find_device


def test_results_with_one_and_two_cpu_threads_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    device, mesh = find_device("cpu", "float64"), box((4, 4, 4), 0.1, distortion=0.1)
    u = device.upload(np.random.default_rng(0).normal(size=(mesh.nodes.size, 3)) * 1e-3)
    found = []
    for number in (1, 2):
        for place in ("sim.terms.elasticity.choose_threads", "sim.linalg.multifrontal.choose_threads"):
            monkeypatch.setattr(place, lambda work, number=number: number)
        problem = compile_problem((Elasticity(tissue("neo-hookean")), Held()), base_held(mesh), device)
        g, _, _ = problem.residual(u)
        z = device.allocate(*u.shape)
        build_rest_solver(problem).apply(g, np.ones(3, bool), z)
        found.append((g.numpy().copy(), problem.longest_step(u, g), z.numpy().copy()))
    for one, two in zip(*found, strict=True):
        np.testing.assert_allclose(two, one, atol=1e-11 * np.abs(one).max())
