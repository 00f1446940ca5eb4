"""Debonding: overloaded bonds release, others hold."""

import numpy as np
import pytest
from boxes import box, hold

from sim.accuracy import REFERENCE
from sim.debonding import solve_with_debonding
from sim.effects import Bonded, Elasticity, Held, NodalForce, Slide
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Nodal
from sim.material import Material

TISSUE = Material("neo-hookean", 3000.0, 0.4)
SIDE = 30e-3  # [m]: six times as long as the bond's tractions are means over


@pytest.fixture(scope="module")
def slab():
    """The base is bonded, a strip of it held beside: what is torn off is not lost."""
    mesh = box((6, 6, 3), SIDE, distortion=0.1)
    base = mesh.nodes[:, 2] < 1e-9
    strip = base & (mesh.nodes[:, 0] > 0.75 * SIDE)
    return hold(mesh, strip, np.where((base & ~strip)[:, None], [0.0, 0.0, -1.0], 0.0))


def lifted(slab, newton):
    """The far edge of the top is pulled up, and the middle pressed down: a tear that grows comes to rest there."""
    nodes = slab.mesh.nodes
    top = nodes[:, 2] > nodes[:, 2].max() - 1e-9
    edge, middle = top & (nodes[:, 0] < 0.2 * SIDE), top & (np.abs(nodes[:, 0] / SIDE - 0.5) < 0.25)
    force = np.zeros((1, len(nodes), 3))
    force[0, edge, 2], force[0, middle, 2] = newton / edge.sum(), -6.0 * newton / middle.sum()
    return Loads((Nodal(force),))


def effects(strength):
    return Elasticity(TISSUE), Held(), Bonded(strength, strength), NodalForce()


@pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
def test_overloaded_bonds_release_outside_the_skull(slab, element):
    loads = lifted(slab, 0.05)
    whole = Fem(slab, effects(1e3), REFERENCE, "cpu", element=element).deform(loads)
    strength = 1e3 * 0.8 * float(whole.bond[0])
    found = solve_with_debonding(slab, effects(strength), loads, REFERENCE, "cpu", element)
    bonded = slab.slide_normal.any(axis=1)
    gone = np.union1d(found.sliding, found.free)
    assert found.converged and found.rounds > 1 and 0 < len(gone) < bonded.sum() and bonded[gone].all()
    assert 0.0 < found.deformation.bond[0] <= 1.0
    moved = found.deformation.displacement[0]
    kept = np.setdiff1d(np.flatnonzero(bonded), gone)
    assert not moved[kept].any()  # what holds, holds
    assert np.abs(moved[found.sliding, 2]).max(initial=0.0) < 1e-9 and np.abs(moved[gone]).max() > 1e-5
    assert moved[found.free, 2].min(initial=0.0) > -1e-7  # the skull is below
    # A body that is held less gives way more: its loads do more work.
    force = loads.get(Nodal).force[0]
    assert np.vdot(force, moved) > 1.001 * np.vdot(force, whole.displacement[0])


def sample_draw_scenario(slab):
    """The top is drawn aside at its far corner: nodes leave the skull and come back to it while the set is sought."""
    nodes = slab.mesh.nodes
    top = nodes[:, 2] > nodes[:, 2].max() - 1e-9
    near = top & (np.hypot(*(nodes[:, :2] - [0.012, 0.03]).T) < 0.3 * SIDE)
    force = np.zeros((1, len(nodes), 3))
    force[0, near] = 0.15 / near.sum() * np.array([-0.874, -0.437, 0.213])
    return Loads((Nodal(force),))


@pytest.mark.parametrize("load", [lambda slab: lifted(slab, 0.05), sample_draw_scenario])
def test_skull_without_bond_strength_bears_only_pressure(slab, load):
    """Signorini's conditions: no penetration, no tension, and released nodes bear nothing."""
    loads = load(slab)
    found = solve_with_debonding(slab, effects(1e-6), loads, REFERENCE, "cpu", "p1")
    assert found.converged and found.deformation.bond[0] == 0.0 and len(found.sliding) and len(found.free)
    held = slab.fixed.copy()
    held[found.sliding, 2] = True
    byhand = Fem(hold(slab.mesh, held), (Elasticity(TISSUE), Held(), NodalForce()), REFERENCE, "cpu", element="p1")
    np.testing.assert_allclose(byhand.deform(loads).displacement, found.deformation.displacement, atol=1e-9)
    assert found.deformation.displacement[0, found.free, 2].min() > -1e-7 and found.rounds < 20


def test_bond_below_its_strength_is_solved_once(slab):
    loads = lifted(slab, 0.05)
    found = solve_with_debonding(slab, effects(1e5), loads, REFERENCE, "cpu")
    whole = Fem(slab, effects(1e5), REFERENCE, "cpu").deform(loads)
    assert found.rounds == 1 and found.converged and not len(found.sliding) and not len(found.free)
    np.testing.assert_array_equal(found.deformation.displacement, whole.displacement)


def test_debonding_without_bond_or_with_two_loads_is_rejected(slab):
    loads = lifted(slab, 0.05)
    with pytest.raises(InputError, match="2 loads debond separately: give one at a time"):
        solve_with_debonding(slab, effects(1e3), loads.select([0, 0]), device="cpu")
    with pytest.raises(InputError, match="there is no bond: add Bonded"):
        solve_with_debonding(slab, (Elasticity(TISSUE), Held(), Slide(), NodalForce()), loads, device="cpu")
