"""Geometry-based models: a motion of the surface is continued into the body by smooth functions, without mechanics.

A point of the surface moves as the surface of a half-space would under the same force (Cerruti, Boussinesq); fixed
vertices stay. Thin-plate splines and free-form lattices continue this motion; Kelvinlets are motions of an infinite
body themselves.
"""

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import RBFInterpolator
from scipy.sparse.linalg import splu

from ..geometry.surface import compute_areas, compute_vertex_normals
from .linear_body import LinearBody

PINS = 400  # Most fixed vertices at which the models stay in place.
LATTICE = 16  # Cells along the longest side of a free-form lattice.
SMOOTHING = 1e-2  # Weight of a lattice's roughness relative to its misfit.


def compute_kelvinlet_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] by regularised Kelvinlets that vanish at fixed vertices.

        u = ((1 - b) / r_e + e^2 / (2 r_e^3) + b / r_e^3 r r^T) f / (4 pi mu),  r_e^2 = r^2 + e^2,  b = 1 / (4 - 4 nu)

    De Goes, James 2017, "Regularized Kelvinlets", ACM Trans. Graph. 36:40, equation 6, with forces at fixed vertices
    that bring these back (section 6). The infinite body has the tissue of most of the mesh.
    """
    points, pins = body.anatomy.mesh.nodes, _choose_pins(body)
    spread = _compute_spacing(body)
    sources = np.concatenate([body.acting, pins])
    whole = _compute_kelvinlets(body, points[np.concatenate([nodes, pins])], points[sources], spread)
    free, known = np.split(whole, [3 * len(nodes)], axis=1)
    acting = 3 * len(body.acting)
    holding = np.linalg.solve(known[acting:].T, -known[:acting].T).T
    return (free[:acting] + holding @ free[acting:]).reshape(len(body.acting), 3, len(nodes), 3)


def compute_thin_plate_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] that a thin-plate spline, phi(r) = r, continues from the surface.

    Bookstein 1989, "Principal warps", IEEE Trans. Pattern Anal. Mach. Intell. 11:567-585, in three dimensions.
    """
    points, controls = body.anatomy.mesh.nodes, np.concatenate([body.acting, _choose_pins(body)])
    unit = np.eye(len(controls))[:, : len(body.acting)]
    spline = RBFInterpolator(points[controls], unit, kernel="linear", degree=1)
    return _continue_surface(body, spline(points[nodes]))


def compute_lattice_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] of a lattice of cubic B-splines fitted to the motion of the surface.

    Sederberg, Parry 1986, "Free-form deformation of solid geometric models"; with the B-splines of Rueckert et al.
    1999, IEEE Trans. Med. Imaging 18:712-721, fitted by least squares with a penalty on the differences of neighbours.
    """
    points, controls = body.anatomy.mesh.nodes, np.concatenate([body.acting, _choose_pins(body)])
    low, high = points.min(axis=0), points.max(axis=0)
    cell = (high - low).max() / LATTICE
    count = np.ceil((high - low) / cell).astype(int) + 3
    fit, read = (_compute_spline_weights((points[some] - low) / cell, count) for some in (controls, nodes))
    rough = _build_differences(count)
    factor = splu(sp.csc_array(fit.T @ fit + SMOOTHING * rough.T @ rough))
    return _continue_surface(body, read @ factor.solve(fit[: len(body.acting)].T.toarray()))


def _continue_surface(body: LinearBody, weight: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] at n points with weights (n, a) of the loaded vertices' motion."""
    return np.einsum("nb,aibj->ainj", weight, _compute_half_space(body), optimize=True)


def _compute_half_space(body: LinearBody) -> np.ndarray:
    """Return surface displacements (a, 3, a, 3) [m/N] of a half-space under unit forces at the loaded vertices.

    Johnson 1985, "Contact Mechanics", sections 3.2 and 3.6; r_e^2 = r^2 + e^2 / 4 bounds the singular point, so that
    the centre of a disc of radius e moves as under uniform pressure.
    """
    mu, nu = _find_main_tissue(body)
    mesh, spread = body.anatomy.mesh, _compute_spacing(body)
    normal = compute_vertex_normals(mesh.nodes, mesh.surface)[body.acting]
    points = mesh.nodes[body.acting]
    arm = points[None] - points[:, None]
    inward = -normal[:, None]
    depth = np.einsum("abi,abi->ab", arm, np.broadcast_to(inward, arm.shape))[..., None]
    along = arm - depth * inward
    far = np.sqrt((along**2).sum(axis=2) + 0.25 * spread**2)[..., None, None]
    out = (1.0 - nu) / far * np.eye(3) + nu / far**3 * along[..., :, None] * along[..., None, :]
    dip = along[..., :, None] * inward[..., None, :]  # motion along the surface, force into it
    out = out + (1.0 - 2.0 * nu) / (2.0 * far**2) * (dip.swapaxes(2, 3) - dip)
    return out.transpose(0, 3, 1, 2) / (2.0 * np.pi * mu)


def _compute_kelvinlets(body: LinearBody, at: np.ndarray, sources: np.ndarray, spread: float) -> np.ndarray:
    """Return displacements (3s, 3n) [m/N] at places (n, 3) [m] under unit forces at sources (s, 3) [m]."""
    mu, nu = _find_main_tissue(body)
    arm = at - sources[:, None]
    length = np.sqrt((arm**2).sum(axis=2) + spread**2)[..., None, None]
    b = 1.0 / (4.0 - 4.0 * nu)
    block = ((1.0 - b) / length + spread**2 / (2.0 * length**3)) * np.eye(3)
    block = block + b * arm[..., :, None] * arm[..., None, :] / length**3
    return block.transpose(0, 2, 1, 3).reshape(3 * len(sources), 3 * len(at)) / (4.0 * np.pi * mu)


def _find_main_tissue(body: LinearBody) -> tuple[float, float]:
    """Return shear modulus [Pa] and Poisson's ratio of the region with the largest volume."""
    label, place = np.unique(body.anatomy.mesh.region, return_inverse=True)
    mu, lam = body.lame[int(label[np.bincount(place, body.anatomy.mesh.volumes).argmax()])]
    return mu, lam / (2.0 * (lam + mu))


def _compute_spacing(body: LinearBody) -> float:
    """Return the radius [m] of a disc with the mean area of a vertex of the surface."""
    mesh = body.anatomy.mesh
    return float(np.sqrt(compute_areas(mesh.nodes[mesh.surface]).sum() / (np.pi * len(np.unique(mesh.surface)))))


def _choose_pins(body: LinearBody) -> np.ndarray:
    """Return at most `PINS` fixed vertices of the surface, far from each other."""
    points = body.anatomy.mesh.nodes
    fixed = np.setdiff1d(body.anatomy.mesh.surface, body.acting)
    chosen = [0]
    far = np.full(len(fixed), np.inf)
    while len(chosen) < min(PINS, len(fixed)):
        far = np.minimum(far, np.linalg.norm(points[fixed] - points[fixed[chosen[-1]]], axis=1))
        chosen.append(int(far.argmax()))
    return fixed[chosen]


def _compute_spline_weights(points: np.ndarray, count: np.ndarray) -> sp.csr_array:
    """Return cubic B-splines (n, m) at points (n, 3) [cells] of a lattice with `count` (3,) nodes along the axes."""
    cell = np.clip(np.floor(points).astype(int), 0, count - 4)
    t = (points - cell)[..., None]
    cubic = np.concatenate([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 3 * (t + t**2 - t**3) + 1, t**3], axis=2) / 6.0
    weight = np.einsum("ni,nj,nk->nijk", *cubic.transpose(1, 0, 2)).reshape(len(points), 64)
    near = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(64, 3)
    place = np.ravel_multi_index(tuple((cell[:, None] + near).transpose(2, 0, 1)), tuple(count))
    return sp.csr_array((weight.ravel(), place.ravel(), np.arange(len(points) + 1) * 64), (len(points), count.prod()))


def _build_differences(count: np.ndarray) -> sp.csr_array:
    """Return the differences (d, m) of neighbours in a lattice with `count` (3,) nodes along each axis."""
    number = np.arange(count.prod()).reshape(count)
    pairs = [np.stack([number.take(range(n - 1), k), number.take(range(1, n), k)]) for k, n in enumerate(count)]
    ends = np.concatenate([each.reshape(2, -1) for each in pairs], axis=1)
    row = np.tile(np.arange(ends.shape[1]), 2)
    value = np.repeat([-1.0, 1.0], ends.shape[1])
    return sp.csr_array((value, (row, ends.ravel())), shape=(ends.shape[1], number.size))
