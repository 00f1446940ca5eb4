"""Inverted tetrahedra: counted, and tracked."""

from dataclasses import replace

import numpy as np
import openings
import pytest
from oracle import tissue
from test_sim_strategy import ACCURACY, MESH, fem, loads

from sim.accuracy import Accuracy
from sim.deformation import Outcome
from sim.discretisation.inverted_elements import InversionCounter
from sim.discretisation.space import discretise
from sim.effects import Elasticity
from sim.elements import ELEMENTS
from sim.fem import Fem
from sim.runtime.device import find_device


def test_inverted_elements_from_undeformed_start_are_counted() -> None:
    """An extreme push: an equilibrium of the law, but not of tissue."""
    load, free = loads(np.array([[0.0, 0.0, -20.0]])), fem(replace(ACCURACY, limit_strain=False))
    found = free.deform(load)
    warm = free.deform(load, found)
    assert found.outcome[0].good and fem().deform(load).outcome[0] is Outcome.INVERTED
    assert found.inverted[0] > 0
    assert warm.outcome[0] is Outcome.CONVERGED_ANEW
    np.testing.assert_array_equal(warm.displacement, found.displacement)


@pytest.mark.parametrize(("law", "followed"), [("neo-hookean", True), ("stable-neo-hookean", False)])
def test_inverted_tetrahedra_of_smoothed_elements_are_tracked(law: str, followed: bool) -> None:
    """A deep push inverts some tetrahedra of the averages, from any start, if the law allows it."""
    effects = (Elasticity(tissue(law)), *openings.EFFECTS)
    deep = 8.0 * np.array([[0.2, 0.1, -1.0]])
    solver = Fem(openings.body()[0], effects, Accuracy(tolerance=1e-6, limit_strain=False), "cpu", element="smoothed")
    before, rest = (solver.deform(openings.loads_of(share * deep)) for share in (0.98, 1.0))
    found = solver.deform(openings.loads_of(deep), before)
    assert before.inverted[0] > 0 and rest.inverted[0] > 0 and found.inverted[0] == rest.inverted[0]
    assert found.outcome[0] is (Outcome.CONVERGED if followed else Outcome.CONVERGED_ANEW)
    size = np.abs(rest.displacement).max()
    np.testing.assert_allclose(found.displacement, rest.displacement, atol=1e-4 * size)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_inverted_tetrahedra_are_counted(element: str, precision: str) -> None:
    """None at rest, rotated or crushed; one with a corner pushed through; all of a mirrored body."""
    space = discretise(MESH, element)
    device = find_device("cpu", precision)  # pyright: ignore[reportArgumentType]
    turn = MESH.nodes @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    through = MESH.nodes.copy()
    alone = np.flatnonzero(np.bincount(MESH.tets.ravel()) == np.bincount(MESH.tets.ravel()).min())[0]
    touching = (MESH.tets == alone).any(axis=1)
    through[alone] += 3.0 * (MESH.nodes.mean(axis=0) - MESH.nodes[alone])
    places = [MESH.nodes, turn, 1e-1 * MESH.nodes, MESH.nodes * [1.0, 1.0, -1.0], 0.0 * MESH.nodes, through]
    u = np.stack([space.interpolate_field(place - MESH.nodes).ravel() for place in places], axis=1)
    count = InversionCounter(space, device).count(device.upload(u))
    every = len(MESH.tets)
    np.testing.assert_array_equal(count[:5], [0, 0, 0, every, every])
    assert 1 <= count[5] <= touching.sum()
