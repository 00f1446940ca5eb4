"""The laws in plain NumPy float64, written from the formulas in F: what the kernels are measured against."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sim.material import LAWS, Material, Ogden, Tissue
from sim.mesh import TetMesh

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
        bulk, terms = coefficients[0], zip(coefficients[1::2], coefficients[2::2], strict=True)
        isochoric = J[:, None] ** (-1.0 / 3.0) * stretch
        return sum(c / m**2 * ((isochoric**m).sum(axis=1) - 3.0) for c, m in terms) + bulk / 2.0 * np.log(J) ** 2
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
        bulk, terms = coefficients[0], zip(coefficients[1::2], coefficients[2::2], strict=True)
        shape = np.sum([c / m * (J ** (-1.0 / 3.0) * stretch) ** m for c, m in terms], axis=0)
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


def internal_forces(mesh: TetMesh, materials: Mapping[int, Tissue], u: np.ndarray) -> np.ndarray:
    """Gradient (V, 3) [N] of the elastic energy at u (V, 3) [m], each region by its own law."""
    out = np.zeros_like(mesh.nodes)
    for label, material in materials.items():
        tets = mesh.tets[mesh.region == label]
        X, x = mesh.nodes[tets], (mesh.nodes + u)[tets]
        rest = np.swapaxes(X[:, 1:] - X[:, :1], 1, 2)
        F = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) @ np.linalg.inv(rest)
        # Forces on corners 1 to 3 are P times the area vectors of the opposite faces: volume x P x rest^-T.
        volume = np.linalg.det(rest)[:, None, None] / 6.0
        force = volume * piola(material.law, F, *material.coefficients) @ np.linalg.inv(rest).transpose(0, 2, 1)
        for corner in range(3):
            np.add.at(out, tets[:, corner + 1], force[:, :, corner])
        np.add.at(out, tets[:, 0], -force.sum(axis=2))
    return out
