"""Elasticity against what is known exactly: affine motions, uniaxial stretch, balance of forces, refinement."""

from __future__ import annotations

import numpy as np
import pytest
from boxes import base_held, box, hold, top_forces
from oracle import EVERY_LAW, internal_forces, piola, tissue

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.effects import Elasticity, Held, NodalForce
from sim.fem import Fem
from sim.loads import Cause, Loads, Nodal, Prescribed
from sim.material import MATERIALS, Material, Ogden, Tissue
from sim.mesh import TetMesh

TIGHT = Accuracy(tolerance=1e-11)
SMALL = 1e-3 * np.array([[1.0, 2.0, -1.0], [0.5, -1.0, 3.0], [-2.0, 1.0, 0.7]])
LARGE = np.array([[0.3, 0.25, -0.1], [0.05, -0.25, 0.2], [-0.2, 0.1, 0.15]])


def solve(anatomy: Anatomy, material: Tissue, cause: Cause, regions: dict[int, Tissue] | None = None) -> np.ndarray:
    """Displacement (V, 3) [m] of the only case."""
    effects = Elasticity(material, regions or {}), Held(), NodalForce()
    found = Fem(anatomy, effects, TIGHT, "cpu").deform(Loads((cause,)))
    assert found.outcome[0].good
    return found.displacement[0]


@pytest.mark.parametrize("law", EVERY_LAW)
@pytest.mark.parametrize("gradient", [SMALL, LARGE], ids=["small", "large"])
def test_patch(law: str, gradient: np.ndarray) -> None:
    """An affine motion of the boundary is the answer inside, whatever the shapes of the elements."""
    mesh = box((3, 3, 3), 0.1, distortion=0.2)
    affine = mesh.nodes @ gradient.T
    surface = np.zeros(len(mesh.nodes), bool)
    surface[mesh.surface] = True
    u = solve(hold(mesh, surface), tissue(law), Prescribed(affine[None]))
    inner = ~surface
    assert inner.sum() == 8
    assert np.abs(u - affine).max() < 1e-10 * max(np.abs(affine).max(), 0.1)


def sleeve(mesh: TetMesh) -> np.ndarray:
    """Symmetry planes of a box: x = 0, y = 0, z = 0 keep their normal component."""
    return mesh.nodes < 1e-9


def principal_stress(material: Tissue, side: float, axial: float) -> tuple[float, float]:
    """Lateral and axial first Piola-Kirchhoff stress [Pa] of the published formula at these stretches."""
    P = piola(material.law, np.diag([side, side, axial])[None], *material.coefficients)[0]
    return P[0, 0], P[2, 2]


def lateral_stretch(material: Tissue, axial: float) -> float:
    """The stretch at which the lateral stress vanishes, by bisection."""
    low, high = 0.2, 3.0
    for _ in range(200):
        middle = (low + high) / 2.0
        low, high = (middle, high) if principal_stress(material, middle, axial)[0] < 0.0 else (low, middle)
    return low


STRETCHED = {law: tissue(law) for law in ("neo-hookean", "stable-neo-hookean", "ogden")} | {
    "minutes": MATERIALS["minutes"].tissue,
    "rubber": Ogden(((2000.0, 6.0), (-300.0, 2.0)), 2e4),
}


@pytest.mark.parametrize("material", STRETCHED.values(), ids=STRETCHED)
@pytest.mark.parametrize("axial", [0.6, 1.5])
def test_uniaxial_stretch_of_a_cube(material: Tissue, axial: float) -> None:
    mesh = box((1, 1, 1), 0.1)
    held = sleeve(mesh)
    top = mesh.nodes[:, 2] > 0.05
    held[top, 2] = True
    value = np.zeros((1, 8, 3))
    value[0, top, 2] = 0.1 * (axial - 1.0)
    u = solve(hold(mesh, held), material, Prescribed(value))
    side = lateral_stretch(material, axial)
    np.testing.assert_allclose(u, mesh.nodes * [side - 1.0, side - 1.0, axial - 1.0], atol=1e-11)
    # The force on the top face is the axial stress times the rest area.
    force = internal_forces(mesh, {0: material}, u)[top, 2].sum()
    assert force == pytest.approx(0.01 * principal_stress(material, side, axial)[1], rel=1e-8)


@pytest.mark.parametrize("law", EVERY_LAW)
def test_uniaxial_tension_at_small_strain_is_youngs_modulus(law: str) -> None:
    mesh, young, poisson = box((2, 2, 2), 0.1), 3000.0, 0.4
    strain = 1e-6
    force = np.zeros((1, len(mesh.nodes), 3))
    # Consistent nodal forces of a uniform traction: a third of every top triangle to each corner.
    top = mesh.surface[(mesh.nodes[mesh.surface][:, :, 2] > 0.1 - 1e-9).all(axis=1)]
    corners = mesh.nodes[top]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
    np.add.at(force[0, :, 2], top.ravel(), np.repeat(young * strain * area / 3.0, 3))
    u = solve(hold(mesh, sleeve(mesh)), tissue(law, young, poisson), Nodal(force))
    np.testing.assert_allclose(u, mesh.nodes * strain * np.array([-poisson, -poisson, 1.0]), atol=1e-4 * strain * 0.1)


@pytest.mark.parametrize("law", EVERY_LAW)
def test_reactions_balance_the_load(law: str) -> None:
    mesh, material = box((2, 2, 3), 0.1, distortion=0.15), tissue(law)
    total = np.array([0.05, 0.02, -0.1])
    u = solve(base_held(mesh), material, Nodal(top_forces(mesh, total)))
    reaction = internal_forces(mesh, {0: material}, u)[mesh.nodes[:, 2] < 1e-9].sum(axis=0)
    np.testing.assert_allclose(reaction, -total, atol=1e-10)


@pytest.mark.parametrize("law", ["corotational", "neo-hookean", "stable-neo-hookean", "ogden"])
def test_turning_the_world_turns_the_answer(law: str) -> None:
    mesh, material = box((2, 2, 3), 0.1, distortion=0.15), tissue(law)
    Q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    Q *= np.linalg.det(Q)
    force = top_forces(mesh, np.array([0.15, 0.1, -0.3]))
    held = mesh.nodes[:, 2] < 1e-9
    u = solve(hold(mesh, held), material, Nodal(force))
    turned = solve(hold(TetMesh(mesh.nodes @ Q.T, mesh.tets, mesh.region), held), material, Nodal(force @ Q.T))
    np.testing.assert_allclose(turned, u @ Q.T, atol=1e-8 * np.abs(u).max())


def test_regions_of_different_laws_share_one_body() -> None:
    """Equilibrium of a linear half on a corotational half, each by its own formula."""
    mesh = box((2, 2, 4), 0.1, distortion=0.1)
    upper = mesh.nodes[mesh.tets].mean(axis=1)[:, 2] > 0.05
    mesh = TetMesh(mesh.nodes, mesh.tets, np.where(upper, 7, -3))
    laws: dict[int, Tissue] = {-3: Material("corotational", 3000.0, 0.3), 7: Material("neo-hookean", 9000.0, 0.45)}
    force = top_forces(mesh, np.array([0.05, 0.0, -0.1]))
    u = solve(base_held(mesh), laws[-3], Nodal(force), {7: laws[7]})
    residual = (internal_forces(mesh, laws, u) - force[0])[mesh.nodes[:, 2] > 1e-9]
    assert np.linalg.norm(residual) < 1e-10 * np.linalg.norm(force)


def test_ogden_regions_may_have_different_numbers_of_terms() -> None:
    mesh = box((2, 2, 4), 0.1, distortion=0.1)
    upper = mesh.nodes[mesh.tets].mean(axis=1)[:, 2] > 0.05
    mesh = TetMesh(mesh.nodes, mesh.tets, upper.astype(int))
    laws: dict[int, Tissue] = {0: Ogden(((1340.0, -19.0),), 1e4), 1: Ogden(((900.0, 2.0), (500.0, -4.0)), 3e4)}
    force = top_forces(mesh, np.array([0.05, 0.0, -0.1]))
    u = solve(base_held(mesh), laws[0], Nodal(force), {1: laws[1]})
    residual = (internal_forces(mesh, laws, u) - force[0])[mesh.nodes[:, 2] > 1e-9]
    assert np.linalg.norm(residual) < 1e-10 * np.linalg.norm(force)


def test_second_order_convergence_to_a_smooth_solution() -> None:
    """A quadratic field, its body force and its boundary values: the error falls fourfold a halving of the mesh."""
    material = Material("linear", 3000.0, 0.3)
    mu, lam = material.lame
    # u_i = x . A_i x / 2; div sigma_i = mu (lap u_i + d_i div u) + lam d_i div u, with d_i div u = sum_j A_j[j, i].
    A = np.random.default_rng(2).normal(size=(3, 3, 3))
    A += A.transpose(0, 2, 1)
    body_force = -(mu * np.trace(A, axis1=1, axis2=2) + (mu + lam) * np.einsum("jji->i", A))
    errors = []
    for cells in (3, 6, 12):
        mesh = box((cells, cells, cells), 0.1, distortion=0.1)
        exact = np.einsum("vj,ijk,vk->vi", mesh.nodes, A, mesh.nodes) / 2.0
        surface = np.zeros(len(mesh.nodes), bool)
        surface[mesh.surface] = True
        share = np.zeros(len(mesh.nodes))
        np.add.at(share, mesh.tets.ravel(), np.repeat(mesh.volumes / 4.0, 4))
        fem = Fem(hold(mesh, surface), [Elasticity(material), Held(), NodalForce()], TIGHT, "cpu")
        loads = Loads((Nodal((share[:, None] * body_force)[None]), Prescribed(exact[None])))
        # Squared at element centres, where the piecewise linear answer's own error shows.
        centre = mesh.nodes[mesh.tets].mean(axis=1)
        found = fem.deform(loads).displacement[0][mesh.tets].mean(axis=1)
        wrong = found - np.einsum("vj,ijk,vk->vi", centre, A, centre) / 2.0
        errors.append(np.sqrt((mesh.volumes * (wrong**2).sum(axis=1)).sum()))
    orders = -np.diff(np.log2(errors))
    assert (orders > 1.8).all()
    assert (orders < 2.4).all()
