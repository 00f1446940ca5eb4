"""The laws in plain NumPy float64, written from the formulas in F: what the kernels are measured against."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy.sparse as sp

from sim.geometry.tetmesh import TetMesh
from sim.material import LAWS, Material, Ogden, Tissue

EVERY_LAW = (*LAWS, Ogden.law)


def tissue(law: str, young: float = 3000.0, poisson: float = 0.45) -> Tissue:
    """A tissue of any law with these constants at small strain; Ogden's has a stiff and a soft term."""
    if law != Ogden.law:
        return Material(law, young, poisson)
    mu, lam = Material("linear", young, poisson).lame
    return Ogden(((1.6 * mu, -4.0), (0.4 * mu, 3.0)), lam + 2.0 * mu / 3.0)


def nearest_rotation(F: np.ndarray) -> np.ndarray:
    """The proper rotations (T, 3, 3) nearest to F, by singular values."""
    U, _, V = np.linalg.svd(F)
    U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
    return U @ V


def energy_density(law: str, F: np.ndarray, *coefficients: float) -> np.ndarray:
    """psi (T,) [Pa] of deformation gradients F (T, 3, 3)."""
    if law == "ogden":
        stretch, J = np.linalg.svd(F, compute_uv=False), np.linalg.det(F)
        bulk, limit, *numbers = coefficients
        y = np.log(J[:, None] ** (-1.0 / 3.0) * stretch)
        psi = bulk / 2.0 * np.log(J) ** 2
        for c, m in zip(numbers[::2], numbers[1::2], strict=True):
            t = np.minimum(m * y, abs(m) * limit)
            d = m * y - t
            psi = psi + c / m**2 * (np.exp(t) * (1.0 + d + d**2 / 2.0 + d**3 / 6.0) - 1.0 - m * y).sum(axis=1)
        return psi
    mu, lam = coefficients
    trace = np.trace(F, axis1=1, axis2=2)
    first = np.einsum("tij,tij->t", F, F)
    J = np.linalg.det(F)
    if law == "linear":
        strain = (F + F.transpose(0, 2, 1)) / 2.0 - np.eye(3)
        return mu * np.einsum("tij,tij->t", strain, strain) + lam / 2.0 * (trace - 3.0) ** 2
    if law == "corotational":
        R = nearest_rotation(F)
        return mu * ((F - R) ** 2).sum(axis=(1, 2)) + lam / 2.0 * (np.einsum("tij,tij->t", R, F) - 3.0) ** 2
    if law == "neo-hookean":
        return mu / 2.0 * (first - 3.0) - mu * np.log(J) + lam / 2.0 * np.log(J) ** 2
    assert law == "stable-neo-hookean"
    return mu / 2.0 * (first - 3.0) - mu * (J - 1.0) + (lam + mu) / 2.0 * (J - 1.0) ** 2


def piola(law: str, F: np.ndarray, *coefficients: float) -> np.ndarray:
    """First Piola-Kirchhoff stress P (T, 3, 3) [Pa]."""
    if law == "ogden":
        U, stretch, V = np.linalg.svd(F)
        J = np.linalg.det(F)[:, None]
        bulk, limit, *numbers = coefficients
        y = np.log(J ** (-1.0 / 3.0) * stretch)
        shape = 0.0
        for c, m in zip(numbers[::2], numbers[1::2], strict=True):
            t = np.minimum(m * y, abs(m) * limit)
            shape = shape + c / m * np.exp(t) * (1.0 + (m * y - t) + (m * y - t) ** 2 / 2.0)
        kirchhoff = shape - shape.mean(axis=1, keepdims=True) + bulk * np.log(J)
        return U @ ((kirchhoff / stretch)[:, :, None] * V)
    mu, lam = coefficients
    J = np.linalg.det(F)[:, None, None]
    if law == "linear":
        trace = np.trace(F, axis1=1, axis2=2)[:, None, None] - 3.0
        return mu * (F + F.transpose(0, 2, 1) - 2.0 * np.eye(3)) + lam * trace * np.eye(3)
    if law == "corotational":
        R = nearest_rotation(F)
        return 2.0 * mu * (F - R) + lam * (np.einsum("tij,tij->t", R, F) - 3.0)[:, None, None] * R
    inverse = np.linalg.inv(F).transpose(0, 2, 1)
    if law == "neo-hookean":
        return mu * (F - inverse) + lam * np.log(J) * inverse
    assert law == "stable-neo-hookean"
    return mu * F - mu * J * inverse + (lam + mu) * (J - 1.0) * J * inverse


@dataclass(frozen=True)
class Samples:
    """S places where an element measures strain: H (S, 3, 3) = gradient (9S, 3N) u, sparse.

    weight (S,) [m^3]; owner (S,) the tetrahedron whose tissue counts; carries: "whole", "shape" or "volume".
    """

    gradient: sp.csr_array
    weight: np.ndarray
    owner: np.ndarray
    carries: str = "whole"


def samples(mesh: TetMesh, element: str = "p1") -> list[Samples]:
    """What the published element measures, built without the package; p2 needs a mesh that brings its middles."""
    if element == "p2":
        return [_quadratic(mesh)]
    linear = _linear(mesh)
    if element == "p1":
        return [linear]
    return [_averaged(mesh, linear, 2, "shape"), _averaged(mesh, linear, 1, "volume")]


def _operator(table: np.ndarray, slope: np.ndarray, nodes: int) -> sp.csr_array:
    """H_ij = sum over nodes of u_ai slope_aj, for tables (S, n) and slopes (S, n, 3)."""
    s, a, i, j = np.indices((*table.shape, 3, 3)).reshape(4, -1)
    place = 9 * s + 3 * i + j, 3 * table[s, a] + i
    return sp.csr_array(sp.coo_array((slope[s, a, j], place), shape=(9 * len(table), 3 * nodes)))


def _linear(mesh: TetMesh) -> Samples:
    corners = mesh.nodes[mesh.tets]
    affine = np.concatenate([np.ones((*mesh.tets.shape, 1)), corners], axis=2)
    slope = np.linalg.inv(affine)[:, 1:].transpose(0, 2, 1)
    gradient = _operator(mesh.tets, slope, len(mesh.nodes))
    return Samples(gradient, np.linalg.det(affine) / 6.0, np.arange(len(mesh.tets)))


def _averaged(mesh: TetMesh, linear: Samples, corners: int, carries: str) -> Samples:
    """Round every edge (2 corners) or node (1) of every region: each tetrahedron lends an equal part to each of its."""
    domains: dict[tuple[int, ...], list[int]] = {}
    for number, tet in enumerate(mesh.tets.tolist()):
        for group in combinations(sorted(tet), corners):
            domains.setdefault((int(mesh.region[number]), *group), []).append(number)
    share = linear.weight / len(list(combinations(range(4), corners)))
    average = np.zeros((len(domains), len(mesh.tets)))
    for row, members in enumerate(domains.values()):
        average[row, members] = share[members]
    weight = average.sum(axis=1)
    spread = sp.kron(sp.csr_array(average / weight[:, None]), sp.eye_array(9))
    owner = np.array([members[0] for members in domains.values()])
    return Samples(sp.csr_array(spread @ linear.gradient), weight, owner, carries)


def monomials(x: np.ndarray) -> np.ndarray:
    """1, x, y, z, x^2, y^2, z^2, xy, yz, zx (q, 10) at points (q, 3)."""
    return np.column_stack([np.ones(len(x)), x, x**2, x * x[:, [1, 2, 0]]])


def compute_quadratic_shapes(x: np.ndarray) -> np.ndarray:
    """The ten shape functions (q, 10) at points (q, 3) of the unit tetrahedron: one at its node, zero at the others."""
    corner = np.vstack([np.zeros(3), np.eye(3)])
    edges = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
    return monomials(x) @ np.linalg.inv(monomials(np.vstack([corner, corner[edges].mean(axis=1)])))


def _quadratic(mesh: TetMesh) -> Samples:
    """Eight points: corners, weight 1/40 each, and face centres, 9/40. Slopes by differences, exact for quadratics."""
    corner = np.vstack([np.zeros(3), np.eye(3)])
    points = np.vstack([corner, [corner[list(face)].mean(axis=0) for face in combinations(range(4), 3)]])
    local = np.stack(
        [
            compute_quadratic_shapes(points + axis / 2.0) - compute_quadratic_shapes(points - axis / 2.0)
            for axis in np.eye(3)
        ],
        axis=2,
    )
    assert mesh.middles is not None
    table = np.hstack([mesh.tets, mesh.middles])
    jacobian = np.einsum("tai,qaj->tqij", mesh.nodes[table], local)
    slope = np.einsum("qaj,tqji->tqai", local, np.linalg.inv(jacobian)).reshape(-1, 10, 3)
    weight = np.linalg.det(jacobian) / 6.0 * np.repeat([1.0 / 40.0, 9.0 / 40.0], 4)
    gradient = _operator(np.repeat(table, 8, axis=0), slope, len(mesh.nodes))
    return Samples(gradient, weight.ravel(), np.repeat(np.arange(len(table)), 8))


def coefficients_carried(material: Tissue, carries: str) -> tuple[float, ...]:
    """Of a tissue whose shape keeps lambda up to 1.5 mu, and whose volume has the rest."""
    if carries == "whole":
        return material.coefficients
    mu, lam = material.lame
    soft = min(lam, 1.5 * mu)
    if isinstance(material, Ogden):
        if carries == "shape":
            return (soft + 2.0 * mu / 3.0, *material.coefficients[1:])
        return lam - soft, 1e3, 0.0, 1.0
    return (mu, soft) if carries == "shape" else (0.0, lam - soft)


def strained(
    mesh: TetMesh, materials: Mapping[int, Tissue], u: np.ndarray, element: str
) -> Iterator[tuple[Samples, np.ndarray, Tissue, np.ndarray]]:
    """For each kind of sample and region: the samples, which of them (S,), the tissue, F (n, 3, 3) there."""
    for kind in samples(mesh, element):
        F = np.eye(3) + (kind.gradient @ u.ravel()).reshape(-1, 3, 3)
        for label, material in materials.items():
            mine = mesh.region[kind.owner] == label
            yield kind, mine, material, F[mine]


def elastic_energy(mesh: TetMesh, materials: Mapping[int, Tissue], u: np.ndarray, element: str = "p1") -> float:
    """[J] at u (N, 3) [m], each region by its own law."""
    return sum(
        float(kind.weight[mine] @ energy_density(material.law, F, *coefficients_carried(material, kind.carries)))
        for kind, mine, material, F in strained(mesh, materials, u, element)
    )


def internal_forces(mesh: TetMesh, materials: Mapping[int, Tissue], u: np.ndarray, element: str = "p1") -> np.ndarray:
    """Gradient (N, 3) [N] of the elastic energy at u (N, 3) [m], each region by its own law."""
    out = np.zeros(u.size)
    for kind, mine, material, F in strained(mesh, materials, u, element):
        stress = np.zeros((len(mine), 3, 3))
        stress[mine] = piola(material.law, F, *coefficients_carried(material, kind.carries))
        out += kind.gradient.T @ (kind.weight[:, None, None] * stress).ravel()
    return out.reshape(u.shape)
