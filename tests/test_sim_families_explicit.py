"""Explicit dynamics ends at the equilibrium of the implicit solver; the condensed table is its linear limit."""

import numpy as np
from conftest import make_box

from sim.accuracy import REFERENCE
from sim.deformation import Outcome
from sim.effects import build_push_effects
from sim.families.registry import build_family
from sim.fem import Fem
from sim.loads import Loads, Nodal, Pushed
from sim.material import Material

BODY = make_box((6, 6, 5), 9e-3, tumour=9e-3, depth=18e-3)
EFFECTS = build_push_effects(BODY, Material("neo-hookean", 3000.0, 0.45))


def push(force):
    count = len(force)
    return Loads((Pushed(np.zeros((count, 3)), np.array(force), np.full(count, 9e-3)),))


def test_explicit_dynamics_ends_at_equilibrium():
    loads = push([[0.02, 0.0, -0.1], [0.0, 0.0, 0.05]])
    exact = Fem(BODY, EFFECTS, REFERENCE, "cpu", element="smoothed").deform(loads)
    found = build_family("explicit", BODY, EFFECTS, "cpu").deform(loads)
    assert found.outcome == (Outcome.CONVERGED,) * 2
    assert np.abs(found.displacement - exact.displacement).max() < 0.005 * np.abs(exact.displacement).max()


def test_condensed_table_is_limit_of_small_loads():
    loads = push([[1e-4, 2e-5, -3e-4]])
    exact = Fem(BODY, EFFECTS, REFERENCE, "cpu", element="smoothed").deform(loads).displacement
    found = build_family("condensed", BODY, EFFECTS, "cpu").deform(loads).displacement
    assert np.abs(found - exact).max() < 1e-3 * np.abs(exact).max()


def test_condensed_table_is_symmetric():
    """Maxwell's reciprocity: the response at b to a force at a is that at a to the same force at b."""
    from sim.families.condensed import compute_response
    from sim.families.linear_body import build_linear_body

    body = build_linear_body("here", BODY, EFFECTS)
    table = compute_response(body, body.loaded)
    np.testing.assert_allclose(table, table.transpose(2, 3, 0, 1), atol=1e-9 * table.max())


def test_nodal_force_displaces_its_own_vertex_most():
    from sim.effects import NodalForce

    force = np.zeros((1, len(BODY.mesh.nodes), 3))
    at = np.flatnonzero(BODY.craniotomy)[0]
    force[0, at] = [0.0, 0.0, -0.01]
    model = build_family("condensed", BODY, (*EFFECTS, NodalForce()), "cpu")
    moved = model.deform(Loads((Nodal(force),))).displacement[0]
    assert moved[at, 2] < 0.0 and np.abs(moved).max() == np.abs(moved[at, 2])
