"""A point force in an infinite body (Kelvin) and on a half space (Boussinesq, Cerruti), some elements away from it."""

from collections.abc import Callable

import numpy as np
import pytest
from boxes import box, hold, quadratic, surface_nodes

from sim.accuracy import Accuracy
from sim.effects import Elasticity, Held, NodalForce, ToolForce
from sim.fem import Fem
from sim.loads import Loads, Nodal, Prescribed, push
from sim.material import Material

SIDE = 0.1
NEAR = {"infinite": 0.03, "half": 0.04}
RADIUS = 0.008
MATERIAL = Material("linear", 3000.0, 0.4)
MU, NU = MATERIAL.lame[0], MATERIAL.poisson
TIGHT = Accuracy(tolerance=1e-9)
FORCE = np.array([0.02, 0.01, -0.05])


def kelvin(arm: np.ndarray, force: np.ndarray) -> np.ndarray:
    """u (n, 3) [m] at arms (n, 3) from a force (3,) [N] in an infinite body. Love 1927, article 130."""
    r = np.linalg.norm(arm, axis=1, keepdims=True)
    along = (arm @ force)[:, None] * arm / r**3
    return ((3.0 - 4.0 * NU) * force / r + along) / (16.0 * np.pi * MU * (1.0 - NU))


def half_space(arm: np.ndarray, force: np.ndarray) -> np.ndarray:
    """u (n, 3) [m] of a force (3,) [N] on the half space z <= 0, at arms (n, 3). Love 1927, articles 135 and 166."""
    r, depth = np.linalg.norm(arm, axis=1), -arm[:, 2]
    x, y, s = arm[:, 0], arm[:, 1], r + depth
    soft, out = 1.0 - 2.0 * NU, np.zeros_like(arm)
    for axis, (a, b) in enumerate(((x, y), (y, x))):
        out[:, axis] += force[axis] * (1.0 / r + a**2 / r**3 + soft * (1.0 / s - a**2 / (r * s**2)))
        out[:, 1 - axis] += force[axis] * a * b * (1.0 / r**3 - soft / (r * s**2))
        out[:, 2] -= force[axis] * a * (depth / r**3 + soft / (r * s))
        out[:, axis] -= force[2] * a * (depth / r**3 - soft / (r * s))
    out[:, 2] += force[2] * (depth**2 / r**3 + 2.0 * (1.0 - NU) / r)
    return out / (4.0 * np.pi * MU)


def under_a_disc(arm: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The half space's u (n, 3) [m] under the tool's traction, sqrt(1 - s^2) on a disc: the sum over its points."""
    node, weight = np.polynomial.legendre.leggauss(8)
    share = (1.0 + node) / 2.0
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    weight = np.repeat(weight * share * np.sqrt(1.0 - share**2), len(angle))
    points = RADIUS * np.outer(share, np.exp(1j * angle)).ravel()
    each = [half_space(arm - [point.real, point.imag, 0.0], force) for point in points]
    return np.einsum("p,pni->ni", weight / weight.sum(), each)


def far_error(space: str, element: str, cells: int) -> float:
    """Of a cube whose surface moves as the exact field says: relative, in the 2-norm over inner nodes away from it.

    In an "infinite" body a nodal force acts at the centre; on a "half" space a tool presses on the top's centre.
    """
    mesh = box((cells, cells, cells), SIDE)
    mesh = quadratic(mesh) if element == "p2" else mesh  # nodes of its own: the far field is exact at all of them
    held = surface_nodes(mesh)
    if space == "infinite":
        at, exact = np.full(3, SIDE / 2.0), kelvin
        force = np.zeros((1, len(mesh.nodes), 3))
        force[0, np.argmin(np.linalg.norm(mesh.nodes - at, axis=1))] = FORCE
        cause = Nodal(force)
    else:
        at, exact = np.array([SIDE / 2.0, SIDE / 2.0, SIDE]), under_a_disc
        sides = (np.abs(mesh.nodes[:, :2] - SIDE / 2.0) > SIDE / 2.0 - 1e-9).any(axis=1)
        held &= sides | (mesh.nodes[:, 2] < 1e-9)
        (cause,) = push(at, FORCE, RADIUS).causes
    arm = mesh.nodes - at
    far = np.linalg.norm(arm, axis=1) > NEAR[space]
    field = np.zeros_like(mesh.nodes)
    field[far] = exact(arm[far], FORCE)
    fem = Fem(
        hold(mesh, held), [Elasticity(MATERIAL), Held(), NodalForce(), ToolForce()], TIGHT, "cpu", element=element
    )
    u = fem.deform(Loads((cause, Prescribed(field[None])))).displacement[0]
    inner = far & ~held
    return float(np.linalg.norm((u - field)[inner]) / np.linalg.norm(field[inner]))


@pytest.mark.parametrize("space", NEAR)
@pytest.mark.parametrize(
    ("element", "cells", "fall", "bound"),
    [("p1", (6, 12), 2.0, 0.04), ("smoothed", (6, 12), 4.0, 0.03), ("p2", (4, 8), 5.0, 0.01)],
)
def test_far_field_agrees_with_point_load_solution(
    space: str, element: str, cells: tuple[int, int], fall: float, bound: float
) -> None:
    coarse, fine = (far_error(space, element, n) for n in cells)
    assert fine < bound
    assert fall < coarse / fine


@pytest.mark.parametrize("field", [kelvin, half_space])
def test_point_load_solutions_are_in_equilibrium(field: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """The traction on a sphere (or half of one) round the force sums to it, and the half space's surface is free."""

    def stress(at: np.ndarray) -> np.ndarray:
        h = 1e-6
        H = np.stack([(field(at + h * e, FORCE) - field(at - h * e, FORCE)) / (2.0 * h) for e in np.eye(3)], axis=2)
        trace = np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        return MU * (H + H.transpose(0, 2, 1)) + MATERIAL.lame[1] * trace

    node, weight = np.polynomial.legendre.leggauss(20)
    whole = field is kelvin
    cosine = node if whole else (node - 1.0) / 2.0
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    ring = np.sqrt(1.0 - cosine**2)
    columns = np.outer(ring, np.cos(angle)), np.outer(ring, np.sin(angle)), np.outer(cosine, np.ones(40))
    normal = np.stack([column.ravel() for column in columns], axis=1)
    area = np.repeat(weight * (1.0 if whole else 0.5), 40) * 2.0 * np.pi / 40.0
    traction = np.einsum("q,qij,qj->i", 0.03**2 * area, stress(0.03 * normal), normal)
    np.testing.assert_allclose(traction, -FORCE, atol=1e-7)
    if not whole:
        at = np.array([[0.03, 0.02, -2e-6], [-0.01, 0.04, -2e-6]])
        assert np.abs(stress(at)[:, :, 2]).max() < 1e-3 * np.abs(stress(at)).max()
