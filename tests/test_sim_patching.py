"""Single loads whose most strained tissue is settled by itself: how often, with what it keeps, and of which nodes."""

from __future__ import annotations

from functools import partial

import numpy as np
from openings import EFFECTS, FINE, OPENING, TOTAL, begun, descent_of
from oracle import tissue

from scenes.script.shipped_files import template_path
from sim.accuracy import TRAIN
from sim.bodies.meshfile import read_anatomy
from sim.deformation import Outcome
from sim.effects import Elasticity, Held, Slide, ToolForce
from sim.fem import Fem
from sim.linalg.multifrontal import Factor
from sim.linalg.preconditioner import rest_solver
from sim.local_solvers.patch import patch_of
from sim.local_solvers.patch_elimination import NODES, PatchSize, patch_elimination
from sim.minimisers.lbfgs_kernels import DONE
from surrogate.data.tool_loads import draw


def test_on_a_brain_hard_pushes_take_few_looks_at_the_whole() -> None:
    anatomy = read_anatomy(template_path())
    effects, loads = (Elasticity(), Held(), Slide(), ToolForce()), draw("spatula", anatomy, 2, 1)
    whole, live = (Fem(anatomy, effects, TRAIN, "cpu", batch=1, live=live, element="p1") for live in (False, True))
    expected, found = whole.deform(loads), live.deform(loads)
    assert set(found.outcome) == {Outcome.CONVERGED} and (found.iterations <= 0.5 * expected.iterations).all()
    moved = np.abs(expected.displacement).max()
    np.testing.assert_allclose(found.displacement, expected.displacement, atol=1e-3 * moved)
    again = [live.deform(loads.rows(np.array([row]))).displacement[0] for row in (1, 0)]
    np.testing.assert_array_equal(again, found.displacement[::-1])


def test_the_next_frame_begins_with_the_patch_of_the_last() -> None:
    law = "stable-neo-hookean"
    problem, space = begun(law, total=TOTAL[3:4])
    descent = descent_of(patch_elimination, problem, space, law)
    rest, tolerance = problem.device.zeros(problem.rows, 1), np.full(1, FINE)
    first = descent.descend(rest, tolerance, 100, {})
    again = descent.descend(rest, tolerance, 100, first.learnt)
    np.testing.assert_array_equal(first.learnt[NODES], np.unique(first.learnt[NODES])[None])
    assert again.status[0] == DONE and again.steps[0] <= first.steps[0]
    np.testing.assert_allclose(again.u.numpy(), first.u.numpy(), atol=1e-6 * np.abs(first.u.numpy()).max())
    elsewhere = descent.descend(rest, tolerance, 100, {NODES: first.learnt[NODES] + len(space.nodes)})
    np.testing.assert_array_equal(elsewhere.u.numpy(), first.u.numpy())
    everything = {NODES: np.repeat(first.learnt[NODES], 100, axis=1)}
    np.testing.assert_array_equal(descent.descend(rest, tolerance, 100, everything).u.numpy(), first.u.numpy())
    assert descent.descend(rest, tolerance, 100).learnt == {}


def test_a_patch_is_in_equilibrium_beside_a_body_at_rest() -> None:
    law = "stable-neo-hookean"
    problem, space = begun(law, total=TOTAL[3:4])
    chosen = OPENING[space.table].any(axis=1)
    nodes, factor = np.unique(space.table[chosen]), rest_solver(problem)
    assert isinstance(factor, Factor)
    inner = factor.compliance((3 * nodes[:, None] + np.arange(3)).ravel())
    patch = patch_of((Elasticity(tissue(law)), *EFFECTS), space, problem, chosen, inner)
    e = inner @ np.where(OPENING[nodes, None], TOTAL[1] / OPENING.sum(), 0.0).ravel()
    share, force = patch.settled(np.zeros_like(e), e, 1e-10)
    assert share == 1.0 and np.abs(force).max() > 1e-4
    x = e + inner @ force
    taken = -patch.excess(np.zeros_like(e), x)  # nothing is strained yet
    np.testing.assert_allclose(patch.free(force), patch.free(taken), atol=1e-6 * np.abs(force).max())


def test_on_a_fine_mesh_patches_are_made_of_what_is_nearest() -> None:
    law = "stable-neo-hookean"
    problem, space = begun(law, total=TOTAL[1:2])
    whole = descent_of(patch_elimination, problem, space, law)
    part = descent_of(partial(patch_elimination, size=PatchSize(near=60)), problem, space, law)
    assert len(part.nodes) < 0.8 * len(whole.nodes) and np.isin(part.nodes, whole.nodes).all()
    found = part.descend(problem.device.zeros(problem.rows, 1), np.full(1, FINE), 100)
    assert found.status[0] == DONE and found.residual[0] <= FINE
