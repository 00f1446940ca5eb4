"""Position-based dynamics converges to the equilibrium of its springs with many short steps."""

from dataclasses import replace
from functools import partial

import numpy as np
from conftest import make_box

from sim.accuracy import REFERENCE
from sim.deformation import Outcome
from sim.effects import build_push_effects
from sim.families.models import RelaxationModel
from sim.families.xpbd import XPBD, Substeps, build_solver, group_tetrahedra
from sim.fem import Fem
from sim.loads import Loads, Pushed
from sim.material import Material

BODY = make_box((5, 5, 4), 9e-3, tumour=8e-3, depth=16e-3, opening=20e-3)
EFFECTS = build_push_effects(BODY, Material("neo-hookean", 3000.0, 0.4))
PUSH = Loads((Pushed(np.zeros((1, 3)), np.array([[0.01, 0.0, -0.04]]), np.array([9e-3])),))


def solve(steps):
    method = replace(XPBD, build_solver=partial(build_solver, settings=steps))
    return RelaxationModel("xpbd", BODY, EFFECTS, method, "cpu").deform(PUSH)


def test_short_steps_reach_the_equilibrium_of_the_springs():
    exact = Fem(BODY, EFFECTS, REFERENCE, "cpu", element="springs").deform(PUSH).displacement
    coarse = solve(Substeps(count=100, step=4e-3, velocity_factor=0.9))
    fine = solve(Substeps(count=2000, step=2e-4, velocity_factor=0.99))
    errors = [np.abs(one.displacement - exact).max() / np.abs(exact).max() for one in (coarse, fine)]
    assert errors[1] < 0.02 < errors[0]
    assert fine.outcome[0] is Outcome.CONVERGED and fine.residual[0] < 0.01
    assert coarse.outcome[0] is Outcome.BUDGET


def test_tetrahedra_of_one_colour_share_no_vertex():
    groups = group_tetrahedra(BODY.mesh.tets)
    assert sorted(np.concatenate(groups)) == list(range(len(BODY.mesh.tets)))
    for group in groups:
        used = BODY.mesh.tets[group].ravel()
        assert len(np.unique(used)) == len(used)
