"""The displacement of a body and of all round it, both ways, on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..anatomy import Anatomy
from ..geometry.tetmesh import signed_volumes
from .collar import beyond_surface
from .extension import extended
from .folds import unfold
from .grid import Grid, grid_around
from .in_tetrahedra import in_tetrahedra
from .inversion import inverted

# Beyond the body the field fades to zero within so much [m], and so many times what the body moves by.
LEAST_REACH, REACHES = 5e-3, 2.0
# Nodes from there to the edge of the grid; what moves less [m] has no inverse to look for.
EDGE, STILL = 2, 1e-5


@dataclass(frozen=True, eq=False)
class WarpFields:
    """How tissue went, on a grid.

    Parameters
    ----------
    grid
        It holds the body at rest and deformed, with a margin.
    forward
        (3, I, J, K) [m]: what was at a node x at rest is now at x + forward(x). Also called *modelling*.
    backward
        (3, I, J, K) [m]: what is at a node y now was at y + backward(y). Also called *resampling*.
    gone
        (I, J, K) bool: nodes at rest in tissue that was taken away.
    least
        The least determinants of the two fields' gradients, and the least volume of a tetrahedron as a share of that
        at rest. Where one is not above 0 something folds.
    reach
        How far from the body the field fades to zero [m].
    """

    grid: Grid
    forward: np.ndarray
    backward: np.ndarray
    gone: np.ndarray
    least: tuple[float, float, float]
    reach: float

    @property
    def folds(self) -> bool:
        """Whether anything folds."""
        return not min(self.least) > 0.0


def reach_of(displacement: np.ndarray) -> float:
    """How far from the body the field of displacements (..., 3) [m] fades to zero [m]."""
    return LEAST_REACH + REACHES * float(np.linalg.norm(displacement, axis=-1).max())


def warp_grid(anatomy: Anatomy, displacements: np.ndarray, spacing: float) -> Grid:
    """The grid of a spacing [m] for a body and its displacements (B, V, 3) [m]."""
    nodes = anatomy.mesh.nodes
    places = np.concatenate([nodes, (nodes + displacements).reshape(-1, 3)])
    return grid_around(places, spacing, reach_of(displacements) + EDGE * spacing)


def forward_on(grid: Grid, body: Anatomy, displacement: np.ndarray) -> tuple[np.ndarray, float]:
    """The field (3, I, J, K) [m] of a body's displacement (V, 3) [m], and its least Jacobian.

    It is linear in each tetrahedron. Just outside it goes on as it is, so that what is read between the grid's nodes
    is right up to the surface. From there it fades to zero.
    """
    nodes, tets = body.mesh.nodes, body.mesh.tets
    field, inside = in_tetrahedra(grid, nodes, tets, displacement)
    collar = ndimage.binary_dilation(inside, np.ones((3, 3, 3))) & ~inside
    numbers = np.flatnonzero(collar)
    field.reshape(3, -1)[:, numbers] = beyond_surface(nodes, tets, displacement, grid.points(numbers)).T
    filled = extended(field, inside | collar, reach_of(displacement) / grid.spacing)
    return filled, unfold(filled, inside, grid.spacing)


def backward_on(grid: Grid, body: Anatomy, displacement: np.ndarray, forward: np.ndarray) -> tuple[np.ndarray, float]:
    """The inverse (3, I, J, K) [m] of a body's displacement (V, 3) [m], and its least Jacobian.

    Within the deformed body it is linear in each tetrahedron. Outside it is the inverse of the forward field.
    """
    now, tets = body.mesh.nodes + displacement, body.mesh.tets
    field, inside = in_tetrahedra(grid, now, tets, -displacement)
    filled = extended(field, inside, reach_of(displacement) / grid.spacing)
    moving = np.maximum(np.abs(filled).max(axis=0), np.abs(forward).max(axis=0)) > STILL
    numbers = np.flatnonzero(~inside & moving)
    flat = filled.reshape(3, -1)
    flat[:, numbers] = inverted(grid, forward, grid.points(numbers), flat[:, numbers].T.astype(np.float64)).T
    return filled, unfold(filled, inside, grid.spacing)


def warp_fields(anatomy: Anatomy, displacement: np.ndarray, spacing: float, left: Anatomy | None = None) -> WarpFields:
    """The fields of a displacement (V, 3) [m] on a grid of a spacing [m].

    `left` is what is left of a body that was cut. Round a body nothing is known: there the fields fade.
    """
    body, grid = left or anatomy, warp_grid(anatomy, displacement[None], spacing)
    mesh = body.mesh
    forward, least_forward = forward_on(grid, body, displacement)
    backward, least_backward = backward_on(grid, body, displacement, forward)
    share = float((signed_volumes(mesh.nodes + displacement, mesh.tets) / mesh.volumes).min())
    gone = np.zeros(grid.shape, bool)
    if len(mesh.tets) < len(anatomy.mesh.tets):
        gone = in_tetrahedra(grid, anatomy.mesh.nodes, anatomy.mesh.tets, displacement)[1]
        gone &= ~in_tetrahedra(grid, mesh.nodes, mesh.tets, displacement)[1]
    least = least_forward, least_backward, share
    return WarpFields(grid, forward, backward, gone, least, reach_of(displacement))


def landmark_errors(fields: WarpFields, nodes: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """How far [m] the field for images takes places (n, 3) [m], displaced by (n, 3) [m], from where they were (n,)."""
    now = nodes + displacement
    return np.linalg.norm(now + fields.grid.read(fields.backward, now) - nodes, axis=1)
