"""Integrals of Kelvin's fundamental solution over triangles with linear shape functions."""

import numpy as np
import warp as wp

from ..runtime.device import find_device, forward_kernel

# Distance to a triangle's centroid, relative to that of its farthest corner, below which the triangle is subdivided.
NEAR = 3.0
MAX_SUBDIVISIONS = 8  # Maximum number of times that the edges of a near triangle are halved.
CORNERS = np.eye(3)  # Barycentric coordinates of a triangle's corners.
# Barycentric corners (4, 3, 3) of the four similar parts of a triangle.
PARTS = 0.5 * np.stack([*(CORNERS + CORNERS[:, None]), 1.0 - CORNERS])


def _build_gauss_rule() -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric points (7, 3) and weights (7,) of a rule of degree 5 (Radon 1948)."""
    root = np.sqrt(15.0)
    near, far = ((6.0 + sign * root) / 21.0 for sign in (-1.0, 1.0))
    points = [np.full((1, 3), 1.0 / 3.0), *(s + (1.0 - 3.0 * s) * CORNERS for s in (near, far))]
    return np.vstack(points), np.repeat([270.0, 155.0 - root, 155.0 + root], [1, 3, 3]) / 1200.0


def _build_duffy_rule(count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric points (count, 3) and weights (count,) of a rule for f/r and g/r^2, with the pole at corner 0.

    f and g are linear, and g is zero at the pole. On each line from the pole, one point is exact (Duffy 1982).
    """
    place, weight = np.polynomial.legendre.leggauss(count)
    return np.stack([np.full(count, 0.5), 0.25 * (1.0 - place), 0.25 * (1.0 + place)], axis=1), 0.5 * weight


GAUSS, DUFFY = _build_gauss_rule(), _build_duffy_rule()
"""Quadrature rules (points, weights) for regular and singular integrals over a triangle of unit area."""


@forward_kernel
def integrate_kelvin(
    corners: wp.array2d(dtype=wp.vec3d),
    points: wp.array(dtype=wp.vec3d),
    weights: wp.array(dtype=wp.float64),
    poisson: wp.float64,
    # outputs
    out: wp.array3d(dtype=wp.mat33d),
):
    """Integrate mu U (index 0) and T (index 1) times each shape function over triangles, for a unit force at 0.

    U_ij = ((3 - 4 nu) d_ij + r_i r_j / r^2) / (16 pi mu (1 - nu) r)
    T_ij = -(r_k n_k ((1 - 2 nu) d_ij + 3 r_i r_j / r^2) + (1 - 2 nu) (n_i r_j - n_j r_i)) / (8 pi (1 - nu) r^3)

    The force has direction i (Brebbia & Dominguez 1992, ch. 4: Kelvin's displacements and tractions).
    """
    m = wp.tid()
    a, b, c = corners[m, 0], corners[m, 1], corners[m, 2]
    cross = wp.cross(b - a, c - a)
    normal = wp.normalize(cross)
    one, two, unit = wp.float64(1.0), wp.float64(2.0), wp.identity(n=3, dtype=wp.float64)
    size = wp.length(cross) / (wp.float64(32.0 * wp.pi) * (one - poisson))
    for q in range(points.shape[0]):
        share = points[q]
        ray = share[0] * a + share[1] * b + share[2] * c
        inverse = one / wp.length(ray)
        ray = inverse * ray
        scale = weights[q] * size * inverse
        product = wp.outer(ray, ray)
        moved = scale * (product + (wp.float64(3.0) - wp.float64(4.0) * poisson) * unit)
        pulled = wp.dot(ray, normal) * ((one - two * poisson) * unit + wp.float64(3.0) * product)
        pulled += (one - two * poisson) * (wp.outer(normal, ray) - wp.outer(ray, normal))
        pulled = -two * scale * inverse * pulled
        for k in range(3):
            out[m, 0, k] += share[k] * moved
            out[m, 1, k] += share[k] * pulled


def _integrate(corners: np.ndarray, rule: tuple[np.ndarray, np.ndarray], poisson: float) -> np.ndarray:
    """Return the results (m, 2, 3, 3, 3) of `integrate_kelvin` over triangles (m, 3, 3) [m], by a quadrature `rule`."""
    device, out = find_device("cpu", "float64"), wp.zeros((len(corners), 2, 3), dtype=wp.mat33d, device="cpu")
    points = device.upload(rule[0], wp.vec3d), device.upload(rule[1])
    device.launch(integrate_kelvin, (len(corners),), [device.upload(corners, wp.vec3d), *points, poisson], [out])
    return out.numpy()


def _is_near(corners: np.ndarray) -> np.ndarray:
    """Return a mask (m,) of triangles with corners (m, 3, 3) that are too close to the origin for the regular rule."""
    centroid = corners.mean(axis=1)
    radius = ((corners - centroid[:, None]) ** 2).sum(axis=2).max(axis=1)
    return (centroid**2).sum(axis=1) < NEAR**2 * radius


def integrate_triangles(corners: np.ndarray, poisson: float) -> np.ndarray:
    """Return integrals of Kelvin's solution for a unit force at the origin, over triangles with corners (m, 3, 3) [m].

    The axes of the result (m, 2, 3, 3, 3) are: triangle; displacement times shear modulus [m], or traction; corner
    whose shape function is a factor; force direction; component. For a corner at the origin, the traction integral does
    not exist and is set to zero. Triangles near the origin are subdivided; triangles with a corner at the origin are
    integrated in Duffy's coordinates.
    """
    out = _integrate(corners, GAUSS, poisson)
    at, pole = np.nonzero((corners == 0.0).all(axis=2))
    order = (np.arange(3) + pole[:, None]) % 3
    out[at[:, None], :, order] = _integrate(corners[at[:, None], order], DUFFY, poisson).swapaxes(1, 2)
    out[at, 1, pole] = 0.0
    near = _is_near(corners)
    near[at] = False
    pairs = np.flatnonzero(near)
    out[pairs] = 0.0
    parts = np.broadcast_to(CORNERS, (len(pairs), 3, 3))
    for level in range(MAX_SUBDIVISIONS + 1):
        inside = parts @ corners[pairs]
        near = _is_near(inside) & (level < MAX_SUBDIVISIONS)
        integral = _integrate(inside[~near], GAUSS, poisson)
        np.add.at(out, pairs[~near], np.einsum("mlk,mslij->mskij", parts[~near], integral, optimize=True))
        pairs, parts = np.repeat(pairs[near], 4), (PARTS @ parts[near, None]).reshape(-1, 3, 3)
    return out
