"""Manufactured solutions: error of elements for a smooth field with its body force and its values on the surface.

Roache 2002, "Code verification by the method of manufactured solutions", J. Fluids Eng. 124:4-10.
"""

import numpy as np
import pytest
from boxes import box, hold, quadratic, surface_nodes
from oracle import compute_quadratic_shapes, piola, tissue
from scipy.special import roots_jacobi

from sim.accuracy import Accuracy
from sim.effects import Elasticity, Held, NodalForce
from sim.fem import Fem
from sim.loads import Loads, Nodal, Prescribed
from sim.material import Tissue

SIDE = 0.1
WAVES = np.array([[2.0, -1.0, 1.5], [1.2, 2.2, 0.7], [-1.6, 1.1, 2.0]]) / SIDE
PHASES = np.array([0.3, 1.1, -0.7])
AMPLITUDE = 0.06 * SIDE


def field(x: np.ndarray) -> np.ndarray:
    """u (..., 3) [m] at points (..., 3): one sine for each component."""
    return AMPLITUDE * np.sin(x @ WAVES.T + PHASES)


def deformation_gradient(x: np.ndarray) -> np.ndarray:
    """F (n, 3, 3) at points (n, 3)."""
    return np.eye(3) + AMPLITUDE * np.cos(x @ WAVES.T + PHASES)[:, :, None] * WAVES


def body_force(material: Tissue, x: np.ndarray) -> np.ndarray:
    """-Div P (n, 3) [N/m^3] at points (n, 3), by sixth-order central differences of the published stress."""
    out, h = np.zeros_like(x), 2e-3 * SIDE
    for axis in np.eye(3):
        for steps, share in ((1, 45.0), (2, -9.0), (3, 1.0)):
            for sign in (-1.0, 1.0):
                F = deformation_gradient(x + sign * steps * h * axis)
                out -= sign * share / (60.0 * h) * piola(material.law, F, *material.coefficients) @ axis
    return out


def quadrature(n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Points (n^3, 3) of the unit tetrahedron and weights (n^3,) of degree 2 n - 1: a cube collapsed, Stroud 1971."""
    (a, wa), (b, wb), (c, wc) = (roots_jacobi(n, power, 0.0) for power in (2.0, 1.0, 0.0))
    x, y, z = np.meshgrid(*((1.0 + root) / 2.0 for root in (a, b, c)), indexing="ij")
    weight = wa[:, None, None] / 8.0 * wb[:, None] / 4.0 * wc / 2.0
    return np.column_stack([x.ravel(), ((1 - x) * y).ravel(), ((1 - x) * (1 - y) * z).ravel()]), weight.ravel()


def error(material: Tissue, element: str, cells: int) -> float:
    """The answer's error over the field, both in L2; forces and error by quadrature of degree 5."""
    mesh = box((cells, cells, cells), SIDE, distortion=0.1)
    points, weight = quadrature()
    shapes = np.column_stack([1.0 - points.sum(axis=1), points])
    places = np.einsum("qa,tai->tqi", shapes, mesh.nodes[mesh.tets])
    table = mesh.tets
    if element == "p2":  # with nodes of its own, so that the surface's values are exact at all of them
        mesh, shapes = quadratic(mesh), compute_quadratic_shapes(points)
        table = np.hstack([mesh.tets, mesh.middles])
    volume = 6.0 * mesh.volumes[:, None] * weight
    force = body_force(material, places.reshape(-1, 3)).reshape(places.shape)
    nodal = np.zeros_like(mesh.nodes)
    np.add.at(nodal, table, np.einsum("tq,qa,tqi->tai", volume, shapes, force))
    effects = Elasticity(material), Held(), NodalForce()
    fem = Fem(hold(mesh, surface_nodes(mesh)), effects, Accuracy(tolerance=1e-7), "cpu", element=element)
    found = fem.deform(Loads((Nodal(nodal[None]), Prescribed(field(mesh.nodes)[None]))))
    assert found.outcome[0].good
    exact = field(places)
    wrong = np.einsum("qa,tai->tqi", shapes, found.displacement[0][table]) - exact
    return float(np.sqrt((volume * (wrong**2).sum(axis=2)).sum() / (volume * (exact**2).sum(axis=2)).sum()))


LEAST_SLOPE = {"p1": 1.85, "p2": 2.85, "smoothed": 1.85}


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
@pytest.mark.parametrize("element", LEAST_SLOPE)
def test_error_decreases_with_expected_order_of_elements(element: str, law: str) -> None:
    """At nu 0.4; stretches from 0.84 to 1.15."""
    cells = np.array([2, 3, 5] if element == "p2" else [3, 5, 8])
    errors = np.array([error(tissue(law, 3000.0, 0.4), element, n) for n in cells])
    slopes = -np.diff(np.log(errors)) / np.diff(np.log(cells))
    assert (slopes >= LEAST_SLOPE[element]).all()
    assert (slopes <= LEAST_SLOPE[element] + 0.6).all()
    assert errors[-1] < 0.02


def test_manufactured_force_is_in_equilibrium_with_stress() -> None:
    """Integrals over the box by another rule: body force + traction on its faces = 0, and the force is not small."""
    material = tissue("neo-hookean", 3000.0, 0.4)
    node, share = np.polynomial.legendre.leggauss(12)
    at, share = SIDE * (1.0 + node) / 2.0, SIDE * share / 2.0
    inside = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    total = np.einsum("a,b,c->abc", share, share, share).ravel() @ body_force(material, inside)
    traction = np.zeros(3)
    plane = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
    for axis in range(3):
        for end, sign in ((0.0, -1.0), (SIDE, 1.0)):
            P = piola(material.law, deformation_gradient(np.insert(plane, axis, end, axis=1)), *material.coefficients)
            traction += sign * np.outer(share, share).ravel() @ P[:, :, axis]
    np.testing.assert_allclose(total, -traction, atol=1e-8 * np.abs(total).max())
    assert np.abs(total).max() > 1.0
