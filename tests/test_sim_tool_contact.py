"""Tools moved by pose: distances, paths, and known properties of contact with elastic bodies."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from boxes import base_held, box

from sim.accuracy import REFERENCE, Accuracy
from sim.deformation import Deformation, Outcome
from sim.effects import Elasticity, Held, ToolContact
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.material import Material
from sim.runtime.user_script import run_script
from sim.tools import Ball, Capsule, Core, Spatula, Tool, compute_distances

SOFT = Material("neo-hookean", 3000.0, 0.45)
SIDE, HEIGHT = 0.08, 0.04
BENT = run_script(Path(__file__).parents[1] / "examples/sucker.py").Bent
BLOCK = base_held(box((8, 8, 4), SIDE))
COARSE = base_held(box((6, 6, 3), SIDE))  # for elements with nodes amid their edges, too, unless the tip is small
TOOLS: dict[str, Tool] = {
    "ball": Ball(7e-3),
    "tip": Ball(2e-3),
    "rod": Capsule(4e-3, 0.02),
    "blade": Spatula(0.015, 0.03, 1.5e-3),
    "own": BENT(3e-3, 0.02, 8e-3),
}
# A tip as deep as it is thick would be swallowed: it has no shaft.
DEPTHS = {"ball": 4e-3, "tip": 1.5e-3, "rod": 4e-3, "blade": 4e-3, "own": 3e-3}


def at(*place: float, turn: np.ndarray | None = None) -> np.ndarray:
    """T_world_tool (4, 4) at a place [m]."""
    T = np.eye(4)
    T[:3, 3] = place
    if turn is not None:
        T[:3, :3] = turn
    return T


def pressed(depth: float, x: float = 0.5 * SIDE + 1e-3, y: float = 0.5 * SIDE - 2e-3) -> Loads:
    """A tool on the block's top, so deep [m]."""
    return Loads((Touching(at(x, y, HEIGHT - depth)[None, None]),))


@cache
def body(name: str, element: str = "p1", accuracy: Accuracy = REFERENCE) -> Fem:
    block = COARSE if element == "p2" and name != "tip" else BLOCK
    return Fem(block, [Elasticity(SOFT), Held(), ToolContact((TOOLS[name],))], accuracy, "cpu", element=element)


@cache
def answer(name: str, element: str) -> Deformation:
    return body(name, element).deform(pressed(DEPTHS[name]))


def seven_by_seven(fem: Fem, found: Deformation) -> np.ndarray:
    """49 points (S, 49, 3) [m] of every deformed surface triangle, as the element has it."""
    space = fem.space
    u = found.displacement[0]
    if len(space.edges):
        middles = space.interpolate_field(u)[len(u) :] + found.memory["mid-edge nodes"][0]
        u = np.vstack([u, middles])
    steps = np.linspace(0.0, 1.0, 7)
    y, z = (grid.ravel() for grid in np.meshgrid(steps, steps))
    L = np.column_stack([1.0 - y, y * (1.0 - z), y * z])
    if space.surface.shape[1] == 6:
        pair = 4.0 * L * np.roll(L, -1, axis=1)
        L = np.hstack([L * (2.0 * L - 1.0), pair])
    return np.einsum("pa,sai->spi", L, (space.nodes + u)[space.surface])


@pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
@pytest.mark.parametrize("name", TOOLS)
def test_no_point_of_the_surface_is_inside_a_tool(name: str, element: str) -> None:
    found = answer(name, element)
    assert found.outcome == (Outcome.CONVERGED,)
    points = seven_by_seven(body(name, element), found).reshape(-1, 3)
    nearest = compute_distances(
        TOOLS[name], at(0.5 * SIDE + 1e-3, 0.5 * SIDE - 2e-3, HEIGHT - DEPTHS[name]), points
    ).min()
    assert 0.0 < nearest < 1e-4


@pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
@pytest.mark.parametrize("name", TOOLS)
def test_tool_reaction_balances_reaction_of_the_base(name: str, element: str) -> None:
    """Force and moment of the tool and of the held nodes are in equilibrium."""
    fem, found = body(name, element), answer(name, element)
    force, moment = found.reaction[0, 0, :3], found.reaction[0, 0, 3:]
    assert force[2] < -0.003
    elastic = fem.problem.device.allocate(fem.problem.rows, 1)
    u = fem.problem.device.upload(fem.guess(pressed(DEPTHS[name]), found))
    for term in fem.problem.terms:
        if term.passive:
            term.add_gradient(u, elastic)
    internal = elastic.numpy().reshape(-1, 3)
    bears = np.where(fem.problem.constraint.fixed, internal, 0.0)
    size = np.linalg.norm(force)
    np.testing.assert_allclose(force, -bears.sum(axis=0), atol=1e-6 * size)
    place = at(0.5 * SIDE + 1e-3, 0.5 * SIDE - 2e-3, HEIGHT - DEPTHS[name])[:3, 3]
    arm = fem.space.nodes + u.numpy().reshape(-1, 3) - place
    np.testing.assert_allclose(moment, -np.cross(arm, bears).sum(axis=0), atol=1e-6 * size * SIDE)


def test_tool_with_two_cores_agrees_with_two_tools() -> None:
    """Two balls: the same motion, and its reaction is theirs about its own origin."""

    @dataclass(frozen=True)
    class Pair:
        apart: float

        @property
        def cores(self) -> tuple[Core, ...]:
            return tuple(Core(np.array([x, 0.0, 6e-3]), np.zeros(3), 6e-3) for x in (0.0, self.apart))

    place, apart = np.array([0.025, 0.04, HEIGHT - 3e-3]), 0.03
    pair = Fem(BLOCK, [Elasticity(SOFT), Held(), ToolContact((Pair(apart),))], REFERENCE, "cpu", element="p1")
    balls = Fem(
        BLOCK, [Elasticity(SOFT), Held(), ToolContact((Ball(6e-3), Ball(6e-3)))], REFERENCE, "cpu", element="p1"
    )
    one = pair.deform(Loads((Touching(at(*place)[None, None]),)))
    both = balls.deform(Loads((Touching(np.stack([at(*place), at(*place + [apart, 0.0, 0.0])])[None]),)))
    assert one.outcome == both.outcome == (Outcome.CONVERGED,)
    assert np.abs(both.displacement).max() > 2e-3
    assert np.abs(one.displacement - both.displacement).max() < 1e-7
    assert one.reaction.shape == (1, 1, 6)
    force = both.reaction[0, :, :3]
    moment = both.reaction[0, :, 3:].sum(axis=0) + np.cross([apart, 0.0, 0.0], force[1])
    assert np.allclose(one.reaction[0, 0], [*force.sum(axis=0), *moment], atol=1e-6)
