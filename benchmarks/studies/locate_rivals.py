"""Baselines of `sulcus locate`: other estimators of a tumour's motion from observed motions of points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import RBFInterpolator
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from sim.accuracy import REFERENCE
from sim.anatomy import TUMOUR_LABEL, Anatomy
from sim.compile import compile_problem
from sim.effects import Elasticity, Held
from sim.families.geometric import compute_kelvinlets
from sim.geometry.closest_point import find_closest_points
from sim.geometry.surface import compute_areas
from sim.material import BRAIN, Material
from sim.runtime.device import find_device
from surrogate.locating.prior import MotionPrior

Rival = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function from undeformed points (n, 3) [m] and their motions (n, 3) [m] to the tumour's motion (q, 3) [m]."""
# Ridge penalty of forces, relative to the response of each point to its own force.
RIDGE = 1e-2
SPREAD = 10e-3  # Radius over which the force of a Kelvinlet is spread [m].
# Candidate smoothings for leave-one-out selection; coordinates are in units of the points' spread.
SMOOTHINGS = 10.0 ** np.arange(-6.0, 3.0)
# Linear tissue, and a tumour twice as stiff; Young's modulus [Pa].
YOUNG, POISSON, STIFFER = 3000.0, 0.45, 2.0
# Springs of the skull in every direction [N/m per m^2], and of each observed point [N/m]. Of 1e2 to 1e6 and of 1 to
# 100 these removed most motion of 20 other cases, over all levels of noise (100 points on 36 % of the cortex).
SKULL, POINT = 3e3, 30.0


def predict_no_motion(positions: np.ndarray) -> Rival:
    """Return zero motion at positions `positions` (q, 3) [m]: the tumour is where the scan shows it."""
    return lambda rest, motion: np.zeros_like(positions)


def fit_rigid_motion(positions: np.ndarray) -> Rival:
    """Fit the rigid motion of the points, at positions (q, 3) [m]: Kabsch 1976, Acta Cryst. A 32:922-923."""

    def moved(rest: np.ndarray, motion: np.ndarray) -> np.ndarray:
        middle, now = rest.mean(axis=0), rest + motion
        turn = Rotation.align_vectors(now - now.mean(axis=0), rest - middle)[0]
        return turn.apply(positions - middle) + now.mean(axis=0) - positions

    return moved


def fit_thin_plates(positions: np.ndarray) -> Rival:
    """Fit thin-plate splines, at positions (q, 3) [m], with the smoothing of least leave-one-out error.

    The error at a left-out point is its coefficient over the diagonal of the inverse: Wahba 1990, "Spline Models for
    Observational Data", section 4.2.
    """

    def moved(rest: np.ndarray, motion: np.ndarray) -> np.ndarray:
        middle, spread = rest.mean(axis=0), rest.std()
        own, there = (rest - middle) / spread, (positions - middle) / spread
        smoothing = min(SMOOTHINGS, key=lambda each: _left_out(own, motion, each))
        return RBFInterpolator(own, motion, smoothing=smoothing, kernel="thin_plate_spline")(there)

    return moved


def _left_out(points: np.ndarray, values: np.ndarray, smoothing: float) -> float:
    """Compute the sum of squared leave-one-out errors of splines at points (n, 3) with values (n, k)."""
    count = len(points)
    square = ((points[:, None] - points) ** 2).sum(axis=2)
    kernel = 0.5 * square * np.log(np.where(square > 0.0, square, 1.0))
    linear = np.column_stack([np.ones(count), points])
    whole = np.block([[kernel + smoothing * np.eye(count), linear], [linear.T, np.zeros((4, 4))]])
    inverse = np.linalg.inv(whole)[:count, :count]
    return float(((inverse @ values / np.diagonal(inverse)[:, None]) ** 2).sum())


def fit_kelvinlets(positions: np.ndarray) -> Rival:
    """Fit regularised Kelvinlets of forces at the points, by ridge regression, at positions (q, 3) [m]."""

    def moved(rest: np.ndarray, motion: np.ndarray) -> np.ndarray:
        size = 3 * len(rest)
        blocks = (compute_kelvinlets(places, rest, SPREAD, BRAIN.poisson) for places in (rest, positions))
        own, there = (block.reshape(size, -1).T for block in blocks)
        ridge = RIDGE * np.trace(own) / size
        force = np.linalg.solve(own.T @ own + ridge**2 * np.eye(size), own.T @ motion.ravel())
        return (there @ force).reshape(-1, 3)

    return moved


@dataclass(frozen=True, eq=False)
class SpringBody:
    """Linear finite elements on springs, condensed to the open cortex and the tumour.

    Parameters
    ----------
    anatomy
        The body.
    compliance
        (m, 3, m + q, 3) [m/N]: motion of the open cortex's m and the tumour's q vertices by unit forces at the former.
    point_stiffness
        Stiffness [N/m] of the spring at each point.
    """

    anatomy: Anatomy
    compliance: np.ndarray
    point_stiffness: float = POINT

    def __call__(self, rest: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Compute as `Rival`, with forces f (n, 3) at the points that solve (C + 1/k) f = motion."""
        size, count = 3 * len(rest), len(self.compliance)
        weights = _on_surface(self.anatomy, rest)
        pulled = np.einsum("nm,miva->niva", weights, self.compliance, optimize=True)
        seen = np.einsum("niva,kv->nika", pulled[:, :, :count], weights, optimize=True).reshape(size, size)
        force = cho_solve(cho_factor(seen + np.eye(size) / self.point_stiffness), motion.ravel())
        return (force @ pulled[:, :, count:].reshape(size, -1)).reshape(-1, 3)


def build_spring_body(anatomy: Anatomy, skull_stiffness: float = SKULL, point_stiffness: float = POINT) -> SpringBody:
    """Assemble linear tetrahedra on springs (skull [Pa/m], point [N/m]), and solve for forces on the open cortex.

    Fixed nodes and nodes under the skull are on springs in all directions. A node's spring has the area of
    the surface that is nearest to it.
    """
    mesh = anatomy.mesh
    stiff = [Material("linear", YOUNG * times, POISSON) for times in (1.0, STIFFER)]
    tissue = Elasticity(stiff[0], {TUMOUR_LABEL: stiff[1]})
    stiffness = compile_problem((tissue, Held()), anatomy, find_device("cpu", REFERENCE.precision)).rest_curvature()
    covered = anatomy.slide_normal.any(axis=1) | anatomy.fixed.any(axis=1)
    area = np.zeros(len(mesh.nodes))
    np.add.at(area, mesh.surface, np.repeat(compute_areas(mesh.nodes[mesh.surface])[:, None] / 3.0, 3, axis=1))
    spring = np.repeat(np.where(covered, skull_stiffness * area, 0.0), 3)
    factor = splu(sp.csc_matrix(stiffness + sp.diags_array(spring)), "MMD_AT_PLUS_A", options={"SymmetricMode": True})
    cortex = np.unique(anatomy.open_surface)
    unknowns = (3 * cortex[:, None] + np.arange(3)).ravel()
    unit = np.zeros((len(spring), len(unknowns)))
    unit[unknowns, np.arange(len(unknowns))] = 1.0
    asked = np.concatenate([cortex, anatomy.tumour_nodes])
    moved = factor.solve(unit).reshape(len(mesh.nodes), 3, -1)[asked]
    return SpringBody(anatomy, np.moveaxis(moved, 2, 0).reshape(len(cortex), 3, len(asked), 3), point_stiffness)


def _on_surface(anatomy: Anatomy, points: np.ndarray) -> np.ndarray:
    """Compute weights (n, m) of the open cortex's vertices at the cortex points nearest to points (n, 3) [m]."""
    triangles, corners = anatomy.open_surface, anatomy.mesh.nodes[anatomy.open_surface]
    vertices = np.unique(triangles)
    weights = np.zeros((len(points), len(vertices)))
    found = find_closest_points(points, corners)
    weights[np.arange(len(points))[:, None], np.searchsorted(vertices, triangles[found.triangle])] = found.weights
    return weights


def build_baselines(anatomy: Anatomy) -> dict[str, Rival]:
    """Build every baseline, by name, with its set-up for a body."""
    at = anatomy.mesh.nodes[anatomy.tumour_nodes]
    return {
        "nothing moved": predict_no_motion(at),
        "best rigid": fit_rigid_motion(at),
        "thin-plate spline": fit_thin_plates(at),
        "Kelvinlets": fit_kelvinlets(at),
        "finite elements on springs": build_spring_body(anatomy),
    }


def fit_oracle(prior: MotionPrior, motion: np.ndarray) -> np.ndarray:
    """Compute the best motion (q, 3) [m] of the tumour's vertices that a sum of a prior's shapes can give.

    It is the least-squares fit to the true motion (V, 3) [m] at the open cortex and the tumour.
    """
    anatomy = prior.anatomy
    cortex, tumour = np.unique(anatomy.open_surface), anatomy.tumour_nodes
    nodes = np.concatenate([cortex, tumour])
    shape = prior.restrict_shapes(nodes).astype(float).reshape(len(prior.shape), -1)
    weight = np.linalg.lstsq(shape.T, motion[nodes].ravel(), rcond=None)[0]
    return np.tensordot(weight, prior.restrict_shapes(tumour), 1)
