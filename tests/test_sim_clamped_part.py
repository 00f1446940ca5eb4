"""Equilibrium of a part of the mesh with a fixed rim."""

import numpy as np
from oracle import tissue
from test_sim_clamped_elimination import BODY, EFFECTS, fem_and_elimination, pressed

from sim.accuracy import Accuracy
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, ToolForce
from sim.fem import Fem
from sim.local_solvers.clamped_part import ClampedPart
from sim.minimisers.residual import compute_constant_gradients


def test_clamped_part_reaches_equilibrium_with_fixed_rim() -> None:
    fem, _ = fem_and_elimination()
    problem, device = fem.problem, fem.problem.device
    problem.begin(Cases(pressed(0.6), np.zeros(1)))
    u = device.upload(1e-4 * np.random.default_rng(0).normal(size=(problem.rows, 1)))
    problem.constraint.project(u)
    chosen = BODY.mesh.nodes[BODY.mesh.tets, 2].max(axis=1) > 0.08
    constant, _ = compute_constant_gradients(problem, u)
    part = ClampedPart(problem, EFFECTS, fem.space, chosen, constant, u)
    settled = part.solve_part(u, 1e-9)
    inside = np.setdiff1d(part.nodes, fem.space.table[~chosen])
    moved = (settled.numpy() != u.numpy()).reshape(-1, 3).any(axis=1)
    assert len(inside) and set(np.flatnonzero(moved)) <= set(inside.tolist())
    free = problem.residual(settled)[0].numpy().reshape(-1, 3)
    assert np.linalg.norm(free[inside]) <= 1.01e-9 < np.linalg.norm(free)


def test_clamped_part_with_non_finite_forces_is_unchanged() -> None:
    fem = Fem(BODY, (Elasticity(tissue("neo-hookean")), Held(), ToolForce()), Accuracy(1e-8), "cpu", element="p2")
    problem = fem.problem
    problem.begin(Cases(pressed(0.6), np.zeros(1)))
    rest = problem.device.allocate(problem.rows, 1)
    folded = problem.device.upload(-2.0 * fem.space.nodes.reshape(-1, 1) * (fem.space.nodes[:, 2:] > 0.0).repeat(3, 0))
    chosen = BODY.mesh.nodes[BODY.mesh.tets, 2].max(axis=1) > 0.04
    part = ClampedPart(problem, fem.effects, fem.space, chosen, compute_constant_gradients(problem, rest)[0], rest)
    np.testing.assert_array_equal(part.solve_part(folded, 1e-9).numpy(), folded.numpy())
