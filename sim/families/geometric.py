"""Geometry-based models: smooth functions extend a motion of the surface into the volume, without mechanics.

Surface points move like the surface of a half-space under the same force (Cerruti, Boussinesq); fixed vertices do not
move. Thin-plate splines and free-form lattices extend this motion into the volume. Kelvinlets are displacement fields
of an infinite body.
"""

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import NdBSpline, RBFInterpolator
from scipy.sparse.linalg import LaplacianNd, splu

from ..geometry.surface import compute_areas, compute_vertex_normals
from .linear_body import LinearBody

PINS = 400  # Maximum number of fixed vertices at which the displacement is forced to zero.
LATTICE = 16  # Cells along the longest side of a free-form lattice.
SMOOTHING = 1e-2  # Weight of a lattice's roughness relative to its misfit.


def compute_kelvinlet_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] by regularised Kelvinlets that vanish at `PINS` fixed vertices.

    Forces at fixed vertices cancel the motion there (section 6 of the paper cited in `compute_kelvinlets`). The
    infinite body has the tissue of the largest region.
    """
    points, pins, (mu, nu) = body.anatomy.mesh.nodes, _choose_fixed_vertices(body), _find_main_tissue(body)
    sources, places = (points[np.concatenate([some, pins])] for some in (body.loaded, nodes))
    whole = compute_kelvinlets(places, sources, _compute_spacing(body), nu) / (4.0 * np.pi * mu)
    whole = whole.reshape(3 * len(sources), 3 * len(places))
    free, known = np.split(whole, [3 * len(nodes)], axis=1)
    acting = 3 * len(body.loaded)
    holding = np.linalg.solve(known[acting:].T, -known[:acting].T).T
    return (free[:acting] + holding @ free[acting:]).reshape(len(body.loaded), 3, len(nodes), 3)


def compute_kelvinlets(points: np.ndarray, sources: np.ndarray, radius: float, poisson: float) -> np.ndarray:
    """Return 4 pi mu x displacements (s, 3, n, 3) [1/m] at points (n, 3) [m] under unit forces at sources (s, 3).

        u = ((1 - b) / r_e + e^2 / (2 r_e^3) + b / r_e^3 r r^T) f / (4 pi mu),  r_e^2 = r^2 + e^2,  b = 1 / (4 - 4 nu)

    Forces are spread over a radius e = `radius` [m] in an infinite body with Poisson's ratio nu.
    De Goes, James 2017, "Regularized Kelvinlets", ACM Trans. Graph. 36:40, equation 6.
    """
    arm = points - sources[:, None]
    length = np.sqrt((arm**2).sum(axis=2) + radius**2)[..., None, None]
    b = 1.0 / (4.0 - 4.0 * poisson)
    block = ((1.0 - b) / length + radius**2 / (2.0 * length**3)) * np.eye(3)
    block += b * arm[..., :, None] * arm[..., None, :] / length**3
    return block.transpose(0, 2, 1, 3)


def compute_thin_plate_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] of a thin-plate spline, phi(r) = r, that interpolates the surface motion.

    Bookstein 1989, "Principal warps", IEEE Trans. Pattern Anal. Mach. Intell. 11:567-585, in three dimensions.
    """
    points, controls = body.anatomy.mesh.nodes, np.concatenate([body.loaded, _choose_fixed_vertices(body)])
    unit = np.eye(len(controls))[:, : len(body.loaded)]
    spline = RBFInterpolator(points[controls], unit, kernel="linear", degree=1)
    return _extrapolate_half_space(body, spline(points[nodes]))


def compute_lattice_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] of a lattice of cubic B-splines, fitted to the surface motion.

    Sederberg, Parry 1986, "Free-form deformation of solid geometric models"; with the B-splines of Rueckert et al.
    1999, IEEE Trans. Med. Imaging 18:712-721, fitted by least squares with a penalty on the differences of neighbours.
    """
    points, controls = body.anatomy.mesh.nodes, np.concatenate([body.loaded, _choose_fixed_vertices(body)])
    low, high = points.min(axis=0), points.max(axis=0)
    cell = (high - low).max() / LATTICE
    count = np.ceil((high - low) / cell).astype(int) + 3
    knots = tuple(np.arange(-3.0, number + 1.0) for number in count)
    fit, read = (NdBSpline.design_matrix((points[some] - low) / cell, knots, 3) for some in (controls, nodes))
    for weights, some in ((fit, controls), (read, nodes)):
        weights.resize(len(some), count.prod())  # SciPy leaves out columns behind the last one in use
    rough = LaplacianNd(tuple(count)).tosparse()
    factor = splu(sp.csc_array(fit.T @ fit - SMOOTHING * rough))
    return _extrapolate_half_space(body, read @ factor.solve(fit[: len(body.loaded)].T.toarray()))


def _extrapolate_half_space(body: LinearBody, weight: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] at n points: `weight` (n, a) times the motion of the loaded vertices.

    The loaded vertices move like the surface of a half-space under unit forces at these vertices.
    Johnson 1985, "Contact Mechanics", sections 3.2 and 3.6; r_e^2 = r^2 + e^2 / 4 bounds the singular point, so that
    the centre of a disc of radius e moves as under uniform pressure.
    """
    (mu, nu), mesh, spread = _find_main_tissue(body), body.anatomy.mesh, _compute_spacing(body)
    inward = -compute_vertex_normals(mesh.nodes, mesh.surface)[body.loaded][:, None]
    arm = mesh.nodes[body.loaded] - mesh.nodes[body.loaded, None]
    along = arm - (arm * inward).sum(axis=2, keepdims=True) * inward
    far = np.sqrt((along**2).sum(axis=2) + 0.25 * spread**2)[..., None, None]
    out = (1.0 - nu) / far * np.eye(3) + nu / far**3 * along[..., :, None] * along[..., None, :]
    dip = along[..., :, None] * inward[..., None, :]  # motion along the surface, force into it
    out = out + (1.0 - 2.0 * nu) / (2.0 * far**2) * (dip.swapaxes(2, 3) - dip)
    return np.einsum("nb,abji->ainj", weight, out / (2.0 * np.pi * mu), optimize=True)


def _find_main_tissue(body: LinearBody) -> tuple[float, float]:
    """Return shear modulus [Pa] and Poisson's ratio of the region with the largest volume."""
    label, place = np.unique(body.anatomy.mesh.region, return_inverse=True)
    mu, lam = body.lame[int(label[np.bincount(place, body.anatomy.mesh.volumes).argmax()])]
    return mu, lam / (2.0 * (lam + mu))


def _compute_spacing(body: LinearBody) -> float:
    """Return the radius [m] of a disc with the mean nodal area of the surface vertices."""
    mesh = body.anatomy.mesh
    return float(np.sqrt(compute_areas(mesh.nodes[mesh.surface]).sum() / (np.pi * len(np.unique(mesh.surface)))))


def _choose_fixed_vertices(body: LinearBody) -> np.ndarray:
    """Return at most `PINS` fixed vertices of the surface that are far from each other."""
    points, fixed = body.anatomy.mesh.nodes, np.setdiff1d(body.anatomy.mesh.surface, body.loaded)
    chosen, far = [0], np.full(len(fixed), np.inf)
    while len(chosen) < min(PINS, len(fixed)):
        far = np.minimum(far, np.linalg.norm(points[fixed] - points[fixed[chosen[-1]]], axis=1))
        chosen.append(int(far.argmax()))
    return fixed[chosen]
