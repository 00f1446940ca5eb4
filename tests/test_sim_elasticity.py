"""Every law on every element against exact solutions: affine motions, stretch and shear, balance of forces."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import base_held, box, hold, quadratic, surface_nodes, top_forces
from oracle import EVERY_LAW, internal_forces, piola, tissue

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.discretisation.space import discretise
from sim.effects import Elasticity, Held, NodalForce
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Cause, Loads, Nodal, Prescribed
from sim.material import Material, Ogden, Tissue
from sim.named_tissues import MATERIALS
from sim.runtime.device import find_device

TIGHT = Accuracy(tolerance=1e-11)
SMALL = 1e-3 * np.array([[1.0, 2.0, -1.0], [0.5, -1.0, 3.0], [-2.0, 1.0, 0.7]])
LARGE = np.array([[0.3, 0.25, -0.1], [0.05, -0.25, 0.2], [-0.2, 0.1, 0.15]])


OWN_NODES = ("p1", "smoothed", "tetra10")
"""Bodies whose nodes are all the mesh's own: forces and displacements are known at each."""
EVERY_BODY = (*OWN_NODES, "p2")


def body(kind: str, cells: tuple[int, int, int], distortion: float = 0.0) -> tuple[TetMesh, str]:
    """A box of 10 cm and the element for it. "tetra10" brings mid-edge nodes; inner ones lie beside their edges."""
    mesh = box(cells, 0.1, distortion)
    return (quadratic(mesh, curved=0.04), "p2") if kind == "tetra10" else (mesh, kind)


def solve(
    anatomy: Anatomy, material: Tissue, cause: Cause, element: str, regions: dict[int, Tissue] | None = None
) -> np.ndarray:
    """Displacement (V, 3) [m] of the only case."""
    effects = Elasticity(material, regions or {}), Held(), NodalForce()
    found = Fem(anatomy, effects, TIGHT, "cpu", element=element).deform(Loads((cause,)))
    assert found.outcome[0].good
    return found.displacement[0]


@pytest.mark.parametrize("kind", EVERY_BODY)
@pytest.mark.parametrize("law", EVERY_LAW)
@pytest.mark.parametrize("gradient", [SMALL, LARGE], ids=["small", "large"])
def test_affine_boundary_motion_gives_affine_interior(law: str, kind: str, gradient: np.ndarray) -> None:
    """An affine motion of the boundary extends to the interior, for all shapes of elements."""
    mesh, element = body(kind, (3, 3, 3), 0.2)
    affine = mesh.nodes @ gradient.T
    surface = surface_nodes(mesh)
    u = solve(hold(mesh, surface), tissue(law), Prescribed(affine[None]), element)
    assert (~surface).sum() == (8 if mesh.middles is None else 125)
    assert np.abs(u - affine).max() < 1e-10 * max(np.abs(affine).max(), 0.1)


def mean_stress(mesh: TetMesh, element: str, material: Tissue, gradient: np.ndarray) -> np.ndarray:
    """Volume mean of P (3, 3) [Pa] under an affine motion, by the virtual work of the elements' own nodal forces."""
    space, device = discretise(mesh, element), find_device("cpu", "float64")
    problem = compile_problem([Elasticity(material), Held()], base_held(mesh), device, space)
    u = device.upload((space.nodes @ gradient.T).reshape(-1, 1))
    return problem.gradient(u).numpy().reshape(-1, 3).T @ space.nodes / mesh.volumes.sum()


def shear_stress(material: Tissue, shear: float) -> float:
    """P_xz [Pa] of x = X + shear Z, in closed form.

    With stretches s and 1/s, s - 1/s = shear, in the plane and none across it; R turns by arctan(shear / 2).
    """
    mu, lam = material.lame
    if isinstance(material, Ogden):
        s = shear / 2.0 + np.sqrt(1.0 + shear**2 / 4.0)
        return sum(c / m * (s**m - s**-m) for c, m in material.terms) / (s + 1.0 / s)
    if material.law == "corotational":
        diagonal = np.sqrt(4.0 + shear**2)
        return 2.0 * mu * (shear - shear / diagonal) + lam * (diagonal - 2.0) * shear / diagonal
    return mu * shear


@pytest.mark.parametrize("kind", EVERY_BODY)
@pytest.mark.parametrize("law", EVERY_LAW)
@pytest.mark.parametrize("shear", [1e-6, 0.5])
def test_simple_shear_stress_agrees_with_formula(law: str, kind: str, shear: float) -> None:
    mesh, element = body(kind, (2, 2, 2), 0.15)
    material = tissue(law)
    P = mean_stress(mesh, element, material, shear * np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    assert P[0, 2] == pytest.approx(shear_stress(material, shear), rel=1e-8)
    assert np.abs(P[:, 1] * [1.0, 0.0, 1.0]).max() < 1e-10 * np.abs(P).max()


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


@pytest.mark.parametrize(
    ("name", "kind"),
    # Sums of one term compile kernels of their own: one element is enough for them.
    [(name, kind) for name in STRETCHED for kind in EVERY_BODY if kind == "p1" or name != "minutes"],
)
@pytest.mark.parametrize("axial", [0.6, 1.5])
def test_uniaxial_stretch_of_cube_agrees_with_formula(name: str, kind: str, axial: float) -> None:
    (mesh, element), material = body(kind, (1, 1, 1)), STRETCHED[name]
    held = sleeve(mesh)
    top = mesh.nodes[:, 2] > 0.1 - 1e-9
    held[top, 2] = True
    value = np.zeros((1, len(mesh.nodes), 3))
    value[0, top, 2] = 0.1 * (axial - 1.0)
    u = solve(hold(mesh, held), material, Prescribed(value), element)
    side = lateral_stretch(material, axial)
    stretch = np.diag([side, side, axial])
    # Pressed to 0.6, a cube of the law with the power -19 hardly resists shear: its residual says less of where it is.
    closeness = 1e-8 if name == "minutes" else 1e-11
    np.testing.assert_allclose(u, mesh.nodes @ (stretch - np.eye(3)), atol=closeness)
    P = mean_stress(mesh, element, material, stretch - np.eye(3))
    stress = principal_stress(material, side, axial)[1]
    np.testing.assert_allclose(P, np.diag([0.0, 0.0, stress]), atol=1e-8 * abs(stress))


@pytest.mark.parametrize("kind", OWN_NODES)
@pytest.mark.parametrize("law", EVERY_LAW)
def test_small_uniaxial_tension_agrees_with_youngs_modulus(law: str, kind: str) -> None:
    mesh, element = body(kind, (2, 2, 2))
    young, poisson, strain = 3000.0, 0.4, 1e-6
    force = np.zeros((1, len(mesh.nodes), 3))
    # Consistent nodal forces of a uniform traction: a third of every top triangle to each corner, or mid-edge node.
    triangles = discretise(mesh, element).surface
    top = triangles[(mesh.nodes[triangles][:, :, 2] > 0.1 - 1e-9).all(axis=1)]
    a, b, c = np.moveaxis(mesh.nodes[top[:, :3]], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    np.add.at(force[0, :, 2], top[:, -3:].ravel(), np.repeat(young * strain * area / 3.0, 3))
    u = solve(hold(mesh, sleeve(mesh)), tissue(law, young, poisson), Nodal(force), element)
    np.testing.assert_allclose(u, mesh.nodes * strain * np.array([-poisson, -poisson, 1.0]), atol=1e-4 * strain * 0.1)


@pytest.mark.parametrize("kind", OWN_NODES)
@pytest.mark.parametrize("law", EVERY_LAW)
def test_reaction_forces_balance_the_load(law: str, kind: str) -> None:
    (mesh, element), material = body(kind, (2, 2, 3), 0.15), tissue(law)
    total = np.array([0.05, 0.02, -0.1])
    u = solve(base_held(mesh), material, Nodal(top_forces(mesh, total)), element)
    reaction = internal_forces(mesh, {0: material}, u, element)[mesh.nodes[:, 2] < 1e-9].sum(axis=0)
    np.testing.assert_allclose(reaction, -total, atol=1e-10)


@pytest.mark.parametrize("kind", EVERY_BODY)
@pytest.mark.parametrize("law", ["corotational", "neo-hookean", "stable-neo-hookean", "ogden"])
def test_rotation_of_the_problem_rotates_the_result(law: str, kind: str) -> None:
    (mesh, element), material = body(kind, (2, 2, 3), 0.15), tissue(law)
    Q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    Q *= np.linalg.det(Q)
    force = top_forces(mesh, np.array([0.15, 0.1, -0.3]))
    held = mesh.nodes[:, 2] < 1e-9
    u = solve(hold(mesh, held), material, Nodal(force), element)
    turned = solve(hold(replace(mesh, nodes=mesh.nodes @ Q.T), held), material, Nodal(force @ Q.T), element)
    np.testing.assert_allclose(turned, u @ Q.T, atol=1e-8 * np.abs(u).max())


@pytest.mark.parametrize(
    "laws",
    [
        {-3: Material("corotational", 3000.0, 0.3), 7: Material("neo-hookean", 9000.0, 0.45)},
        {-3: Ogden(((1340.0, -19.0),), 1e4), 7: Ogden(((900.0, 2.0), (500.0, -4.0)), 3e4)},
    ],
    ids=["two laws", "two numbers of terms"],
)
@pytest.mark.parametrize("kind", OWN_NODES)
def test_regions_with_different_laws_are_in_equilibrium(kind: str, laws: dict[int, Tissue]) -> None:
    """Equilibrium of an upper half on another lower half, each by its own formula."""
    mesh, element = body(kind, (2, 2, 4), 0.1)
    upper = mesh.nodes[mesh.tets].mean(axis=1)[:, 2] > 0.05
    mesh = replace(mesh, region=np.where(upper, 7, -3))
    force = top_forces(mesh, np.array([0.05, 0.0, -0.1]))
    u = solve(base_held(mesh), laws[-3], Nodal(force), element, {7: laws[7]})
    residual = (internal_forces(mesh, laws, u, element) - force[0])[mesh.nodes[:, 2] > 1e-9]
    assert np.linalg.norm(residual) < 1e-10 * np.linalg.norm(force)
