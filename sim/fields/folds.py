"""Detection and removal of folds (negative Jacobian determinants) in displacement fields."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize

from .extension import smooth_field


@dataclass(frozen=True)
class UnfoldingSettings:
    """Settings of `unfold_field`."""

    min_determinant: float = 0.05  # Jacobian determinant below which a cell is corrected
    target_determinant: float = 0.15  # target determinant of the correction
    margin: int = 2  # margin of movable nodes around such a cell
    max_attempts: int = 12  # maximum attempts
    max_iterations: int = 200  # maximum iterations per attempt
    first_smoothed_attempt: int = 4  # attempt from which folds are smoothed first, to leave local minima
    smoothing_iterations: int = 3  # smoothing iterations of such an attempt
    # Weights of a node's squared move [spacings] relative to a cell's squared volume deficit.
    body_weight: float = 1.0  # in the body
    collar_weight: float = 0.1  # in the collar
    outer_weight: float = 1e-4  # elsewhere


UNFOLDING = UnfoldingSettings()
# Relative edge change below which no corner of a cell can fold.
MAX_SAFE_CHANGE = 0.15
# Slices per block, to limit memory.
BLOCK_SLICES = 4
# Corners of a cell, and for each corner its three edge neighbours, ordered for a volume of consistent sign.
CORNERS = np.array(list(np.ndindex(2, 2, 2)))
CORNER_NEIGHBOURS = np.array([[corner, *np.where(np.eye(3, dtype=int), 1 - corner, corner)] for corner in CORNERS])
CORNER_SIGNS = (1.0 - 2.0 * CORNERS).prod(axis=1)


def compute_jacobians(field: np.ndarray, spacing: float) -> np.ndarray:
    """Return the smallest Jacobian determinant of each cell (I - 1, J - 1, K - 1) for a field (3, I, J, K) [m].

    The determinant is that of 1 + gradient. At each of the eight corners of a cell, the gradient of the trilinear
    interpolation follows from differences along three edges, with node `spacing` [m]. The field folds where the
    determinant is negative. For cells with small deformation, only one corner is evaluated.
    """
    found = np.empty(tuple(side - 1 for side in field.shape[1:]), np.float32)
    for first in range(0, len(found), BLOCK_SLICES):
        part = field[:, first : first + BLOCK_SLICES + 1] / np.float32(spacing)
        ax, ay, az = np.diff(part, axis=1)
        bx, by, bz = np.diff(part, axis=2)
        cx, cy, cz = np.diff(part, axis=3)
        sides = tuple(side - 1 for side in part.shape[1:])
        most = np.zeros(sides, np.float32)
        for edges in (ax, ay, az, bx, by, bz, cx, cy, cz):
            size = np.abs(edges)
            for axis, side in enumerate(sides):
                if size.shape[axis] > side:
                    near, far = (np.take(size, range(at, at + side), axis) for at in (0, 1))
                    size = np.maximum(near, far)
            np.maximum(most, size, out=most)
        at = tuple(slice(side) for side in sides)
        ax, ay, az, bx, by, bz, cx, cy, cz = (edges[at] for edges in (ax, ay, az, bx, by, bz, cx, cy, cz))
        ax, by, cz = ax + 1.0, by + 1.0, cz + 1.0
        least = ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx)
        strong = np.argwhere(most > MAX_SAFE_CHANGE)
        places = (part + np.indices(part.shape[1:], np.float64)).reshape(3, -1).T
        least[tuple(strong.T)] = compute_corner_volumes(places, find_corner_nodes(strong, part.shape[1:])).min(axis=1)
        found[first : first + BLOCK_SLICES] = least
    return found


def find_corner_nodes(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return node numbers (n, 8, 4) in a grid: each corner of cells (n, 3), then the other ends of its edges."""
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(cells[:, None, None] + CORNER_NEIGHBOURS, -1, 0)), shape))


def compute_corner_volumes(positions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return signed volumes (n, 8) at the corners (n, 8, 4) of cells, from node positions (N, 3) [spacings]."""
    at = positions[corners]
    return CORNER_SIGNS * np.linalg.det(at[:, :, 1:] - at[:, :, :1])


def unfold_field(field: np.ndarray, inside: np.ndarray, collar: np.ndarray, spacing: float) -> float:
    """Remove folds of a field (3, I, J, K) [m] in place, and return the smallest Jacobian determinant afterwards.

    Nodes in the mask `inside` (I, J, K) of the mesh change least, then nodes of the surrounding layer `collar` (I, J,
    K); the surface of the mesh is between these two. The squared volume deficit of cell corners is minimised, as for
    meshes in Escobar et al. 2003, "Simultaneous untangling and smoothing of tetrahedral meshes". Folds that remain are
    smoothed before another attempt; there the mesh itself may be folded.
    """
    found = compute_jacobians(field, spacing)
    for turn in range(UNFOLDING.max_attempts):
        bad = found < UNFOLDING.min_determinant
        if not bad.any():
            break
        grown, labels = UNFOLDING.margin + turn, np.empty(bad.shape, np.int32)
        ndimage.label(ndimage.maximum_filter(bad, 2 * grown + 5), output=labels)
        for where in ndimage.find_objects(labels):
            window = tuple(slice(each.start, each.stop + 1) for each in where)
            part, nodes = field[(slice(None), *window)], np.pad(bad[where], [(0, 1)] * 3)
            near = ndimage.maximum_filter(nodes, 2 * grown + 2)
            if turn >= UNFOLDING.first_smoothed_attempt:
                smooth_field(part, ndimage.maximum_filter(nodes, 2 * turn + 2), UNFOLDING.smoothing_iterations)
            outer = np.where(collar[window], UNFOLDING.collar_weight, UNFOLDING.outer_weight)
            stiff = np.where(inside[window], UNFOLDING.body_weight, outer)
            _repair_cells(part, near, stiff, spacing)
            found[where] = compute_jacobians(part, spacing)
    return float(found.min())


def _repair_cells(field: np.ndarray, mask: np.ndarray, weights: np.ndarray, spacing: float) -> None:
    """Change nodes in `mask` of a field part (3, I, J, K) [m], in place, until no cell is folded."""
    shape = mask.shape
    mask[[0, -1]] = mask[:, [0, -1]] = mask[:, :, [0, -1]] = False
    cells = np.argwhere(ndimage.maximum_filter(mask, 2, origin=-1)[:-1, :-1, :-1])
    used, corners = np.unique(find_corner_nodes(cells, shape), return_inverse=True)
    corners, signs = corners.reshape(-1, 4), np.tile(CORNER_SIGNS, len(cells))
    flat = field.reshape(3, -1)
    rest = flat[:, used].T / spacing + np.stack(np.unravel_index(used, shape), axis=-1)
    free = np.flatnonzero(mask.reshape(-1)[used])
    held = weights.reshape(-1)[used[free], None]

    def compute_cost(variables: np.ndarray) -> tuple[float, np.ndarray]:
        change, places = variables.reshape(-1, 3), rest.copy()
        places[free] += change
        at = places[corners]
        a, b, c = np.moveaxis(at[:, 1:] - at[:, :1], 1, 0)
        ends = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
        lack = np.maximum(UNFOLDING.target_determinant - signs * (a * ends[:, 0]).sum(axis=1), 0.0)
        some = np.flatnonzero(lack > 0.0)
        pull = -2.0 * (signs[some] * lack[some])[:, None, None] * ends[some]
        pulls, pulled = np.concatenate([-pull.sum(axis=1, keepdims=True), pull], axis=1), corners[some].ravel()
        slope = np.stack([np.bincount(pulled, each.ravel(), len(rest)) for each in np.moveaxis(pulls, -1, 0)], axis=-1)
        size = float((lack * lack).sum() + (held * change * change).sum())
        return size, (slope[free] + 2.0 * held * change).ravel()

    options = {"maxiter": UNFOLDING.max_iterations}
    found = minimize(compute_cost, np.zeros(3 * len(free)), jac=True, method="L-BFGS-B", options=options)
    change = (spacing * found.x.reshape(-1, 3).T).astype(field.dtype)
    for values, more in zip(field, change, strict=True):
        values[np.unravel_index(used[free], shape)] += more
