"""Forward and backward displacement fields of a mesh and its surroundings on a grid."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..anatomy import Anatomy
from ..geometry.tetmesh import compute_signed_volumes
from .extension import extend_field
from .folds import unfold_field
from .grid import Grid, build_grid_around
from .grid_interpolation import interpolate_in_tetrahedra
from .inversion import invert_field
from .near_surface import extrapolate_beyond_surface
from .projection import NodalField, project_field

MIN_DIVISOR = 1e-30  # guard against division by 0


@dataclass(frozen=True)
class WarpFieldSettings:
    """Settings for the grid of displacement fields and for negligible displacements."""

    min_fade_distance: float = 5e-3  # constant part of the distance over which the field fades to zero [m]
    fade_factor: float = 2.0  # variable part of that distance [maximum displacements]
    grid_margin: int = 3  # margin of the grid beyond that distance [nodes]
    inversion_threshold: float = 1e-5  # displacement below which no inverse is computed [m]
    # Displacement below which it is set to 0 [m]; above twice the limit it is unchanged.
    zeroing_threshold: float = 2e-5
    zeroing_fraction: float = 2.5e-3  # Maximum of that limit, as a fraction of the maximum displacement.


WARP_FIELDS = WarpFieldSettings()


@dataclass(frozen=True, eq=False)
class WarpFields:
    """Forward and backward displacement fields of tissue on a grid.

    Parameters
    ----------
    grid
        Grid that contains the undeformed and the deformed mesh, with a margin.
    forward
        Field (3, I, J, K) [m]: the undeformed position x moves to x + forward(x). Also called *modelling*.
    backward
        Field (3, I, J, K) [m]: the deformed position y was at y + backward(y) before. Also called *resampling*.
    resected
        Mask (I, J, K) of nodes in resected tissue, in the undeformed configuration.
    min_determinants
        Smallest Jacobian determinants of `forward` and `backward`, and smallest relative volume of a tetrahedron. A
        value <= 0 shows a fold of this field or of the mesh.
    fade_distance
        Distance from the mesh over which the fields fade to zero [m].
    """

    grid: Grid
    forward: np.ndarray
    backward: np.ndarray
    resected: np.ndarray
    min_determinants: tuple[float, float, float]
    fade_distance: float

    @property
    def has_folds(self) -> bool:
        """True if `forward` or `backward` has a fold."""
        return not min(self.min_determinants[:2]) > 0.0


def compute_fade_distance(displacement: np.ndarray) -> float:
    """Return the distance [m] over which the field fades to zero outside the mesh, from displacements (..., 3) [m]."""
    largest = float(np.linalg.norm(displacement, axis=-1).max())
    return WARP_FIELDS.min_fade_distance + WARP_FIELDS.fade_factor * largest


def compute_cutoff(displacement: np.ndarray) -> float:
    """Return the magnitude [m] below which displacements (..., 3) [m] are neglected to make the grid smaller."""
    largest = float(np.linalg.norm(displacement, axis=-1).max())
    return min(WARP_FIELDS.zeroing_threshold, WARP_FIELDS.zeroing_fraction * largest)


def remove_negligible(displacement: np.ndarray) -> np.ndarray:
    """Return displacements (..., 3) [m], with negligible displacements set to zero."""
    size = np.linalg.norm(displacement, axis=-1, keepdims=True)
    share = np.clip(size / max(compute_cutoff(displacement), MIN_DIVISOR) - 1.0, 0.0, 1.0)
    return displacement * (share * share * (3.0 - 2.0 * share))


def build_warp_grid(anatomy: Anatomy, displacements: np.ndarray, spacing: float) -> Grid:
    """Return the grid with a `spacing` [m] around the part of the anatomy that `displacements` (B, V, 3) [m] move."""
    mesh, moves = anatomy.mesh, np.asarray(displacements.any(axis=(0, 2)))
    tets, faces = (of[moves[of].any(axis=1)] for of in (mesh.tets, mesh.surface))
    held, outer = np.unique(tets if len(tets) else mesh.tets), np.unique(faces)
    reach = compute_fade_distance(displacements)
    places = [mesh.nodes[held], *(mesh.nodes[held] + displacements[:, held])]
    for some in (mesh.nodes[outer], *(mesh.nodes[outer] + displacements[:, outer])):
        places += [some - reach, some + reach]
    return build_grid_around(np.concatenate(places), spacing, WARP_FIELDS.grid_margin * spacing)


def find_collar(inside: np.ndarray) -> np.ndarray:
    """Return the mask (I, J, K) of the nodes outside a mesh that are neighbours of nodes in the mask `inside`."""
    return np.asarray(ndimage.maximum_filter(inside, 3) & ~inside)


def compute_forward(grid: Grid, body: Anatomy, displacement: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the forward field (3, I, J, K) [m] of a displacement (V, 3) [m], and its smallest Jacobian determinant.

    The field is linear in each tetrahedron, and fitted where sampling is not accurate between grid nodes. Just outside
    the mesh the field is extrapolated, to be accurate up to the surface; farther away it fades to zero.
    """
    nodes, tets = body.mesh.nodes, body.mesh.tets
    field, inside = interpolate_in_tetrahedra(grid, nodes, tets, displacement)
    collar = find_collar(inside)
    numbers = np.flatnonzero(collar)
    field.reshape(3, -1)[:, numbers] = extrapolate_beyond_surface(
        nodes, tets, displacement, grid.compute_positions(numbers)
    ).T
    project_field(grid, field, inside, collar, NodalField(nodes, tets, displacement))
    filled = extend_field(field, inside | collar, compute_fade_distance(displacement) / grid.spacing)
    return filled, unfold_field(filled, inside, collar, grid.spacing)


def compute_inverse(
    grid: Grid, body: Anatomy, displacement: np.ndarray, forward: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the backward field (3, I, J, K) [m] of a displacement (V, 3) [m], and its smallest Jacobian determinant.

    In the deformed mesh the field is linear in each tetrahedron, and fitted. Outside, it is the inverse of `forward`.
    """
    now, tets = body.mesh.nodes + displacement, body.mesh.tets
    field, inside = interpolate_in_tetrahedra(grid, now, tets, -displacement)
    numbers = np.flatnonzero(~inside & (np.abs(forward).max(axis=0) > WARP_FIELDS.inversion_threshold))
    flat, guess = field.reshape(3, -1), -forward.reshape(3, -1)[:, numbers].T.astype(np.float64)
    flat[:, numbers] = invert_field(grid, forward, grid.compute_positions(numbers), guess).T
    collar = find_collar(inside)
    project_field(grid, field, inside, collar, NodalField(now, tets, -displacement))
    return field, unfold_field(field, inside, collar, grid.spacing)


def compute_warp_fields(
    anatomy: Anatomy,
    displacement: np.ndarray,
    spacing: float,
    remaining_anatomy: Anatomy | None = None,
    progress: Callable[[], object] = lambda: None,
) -> WarpFields:
    """Return forward and backward fields of a displacement (V, 3) [m] on a grid with a `spacing` [m].

    `remaining_anatomy` is the anatomy after a resection. Outside the mesh the fields fade to zero. The function
    `progress` is called after each of the two fields.
    """
    displacement = remove_negligible(displacement)
    body, grid = remaining_anatomy or anatomy, build_warp_grid(anatomy, displacement[None], spacing)
    mesh = body.mesh
    forward, least_forward = compute_forward(grid, body, displacement)
    progress()
    backward, least_backward = compute_inverse(grid, body, displacement, forward)
    progress()
    share = float((compute_signed_volumes(mesh.nodes + displacement, mesh.tets) / mesh.volumes).min())
    resected = np.zeros(grid.shape, bool)
    if len(mesh.tets) < len(anatomy.mesh.tets):
        resected = interpolate_in_tetrahedra(grid, anatomy.mesh.nodes, anatomy.mesh.tets, displacement)[1]
        resected &= ~interpolate_in_tetrahedra(grid, mesh.nodes, mesh.tets, displacement)[1]
    least = least_forward, least_backward, share
    return WarpFields(grid, forward, backward, resected, least, compute_fade_distance(displacement))
