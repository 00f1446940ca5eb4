"""Consistency of the coordinate systems of several files; detection of LPS coordinates declared as RAS."""

from collections.abc import Iterable

import numpy as np
from scipy.spatial import ConvexHull

from ..errors import InputError
from .label_map import Mask
from .voxels import LPS, VoxelGrid

MIN_INSIDE_FRACTION = 0.5  # fraction of points inside, below which the spaces differ
MIN_MIRRORED_FRACTION = 0.9  # fraction inside after negating x and y, above which LPS is the cause
TEST_POINTS = 500  # approximate number of tested points
EXPORT_REMEDY = "one of the two states LPS as RAS. Export that one again."


def is_mirroring_ambiguous(brain: Mask, tumour: Mask) -> bool:
    """Return True if brain and tumour have different grids and would also fit with x and y of the tumour negated.

    Raises
    ------
    InputError
        The tumour is outside the brain, or LPS coordinates are evidently declared as RAS.
    """
    check_not_negated(brain.grid, tumour.grid)
    boxes = [mask.box for mask in (brain, tumour)]
    apart = (boxes[0][0] > boxes[1][1]).any() or (boxes[1][0] > boxes[0][1]).any()
    points = _compute_positions(tumour.grid, _thin_points(np.argwhere(tumour.voxels)))
    planes = ConvexHull(_widen_outline(brain)).equations
    within, turned = (_compute_fraction_within(planes, points * signs) for signs in (np.ones(3), LPS))
    if within < MIN_INSIDE_FRACTION and turned > MIN_MIRRORED_FRACTION:
        raise InputError(
            f"{tumour.path}: its tumour lies at {_format_box(boxes[1])}, and the brain of {brain.path} at "
            f"{_format_box(boxes[0])}. With x and y negated it would lie in the brain: {EXPORT_REMEDY}"
        )
    if apart:
        raise InputError(
            f"{tumour.path}: its tumour lies at {_format_box(boxes[1])} and does not overlap the brain of "
            f"{brain.path}, at {_format_box(boxes[0])}. Give volumes of one space, or resample one into the other's."
        )
    return turned > MIN_MIRRORED_FRACTION and not _is_same_grid(brain.grid, tumour.grid)


def check_scan_space(brain: Mask, scan: VoxelGrid, grids: Iterable[VoxelGrid]) -> None:
    """Reject a scan with LPS coordinates declared as RAS; `grids` are those of the files that mark the `brain`.

    Raises
    ------
    InputError
        The scan's grid equals one of `grids` with x and y negated, or the scan contains the brain only if negated.
    """
    for grid in grids:
        check_not_negated(grid, scan)
    points = _thin_points(brain.outline)
    within, turned = (compute_inside_fraction(scan.shape, scan.affine, points * signs) for signs in (np.ones(3), LPS))
    if within < MIN_INSIDE_FRACTION and turned > MIN_MIRRORED_FRACTION:
        raise InputError(
            f"{scan.path}: holds {100.0 * within:.0f} % of the brain of {brain.path}. With x and y negated it would "
            f"hold {100.0 * turned:.0f} %: {EXPORT_REMEDY}"
        )


def check_not_negated(grid: VoxelGrid, other_grid: VoxelGrid) -> None:
    """Reject two grids if one grid equals the other with x and y negated.

    Raises
    ------
    InputError
        The grids are equal with x and y negated.
    """
    negated = np.array([*LPS, 1.0])[:, None] * other_grid.affine
    if _is_same_grid(grid, VoxelGrid(other_grid.path, other_grid.shape, negated)):
        raise InputError(f"{other_grid.path}: has the grid of {grid.path}, but with x and y negated: {EXPORT_REMEDY}")


def _is_same_grid(grid: VoxelGrid, other_grid: VoxelGrid) -> bool:
    return grid.shape == other_grid.shape and np.allclose(grid.affine, other_grid.affine, rtol=0.0, atol=1e-6)


def _thin_points(points: np.ndarray) -> np.ndarray:
    """Return a regular subset of the points, with at least `TEST_POINTS` points or all points."""
    return points[:: max(1, len(points) // TEST_POINTS)]


def _compute_positions(grid: VoxelGrid, index: np.ndarray) -> np.ndarray:
    """Return the positions (n, 3) [m] of the voxels with indices (n, 3)."""
    return index @ grid.affine[:3, :3].T + grid.affine[:3, 3]


def compute_inside_fraction(shape: tuple[int, ...], affine: np.ndarray, points: np.ndarray) -> float:
    """Return the fraction of points (n, 3) [m] inside a volume (I, J, K) with affine (4, 4) from indices to metres."""
    inverse = np.linalg.inv(affine)
    index = np.rint(points @ inverse[:3, :3].T + inverse[:3, 3])
    return float(((index >= 0) & (index < np.array(shape))).all(axis=1).mean())


def _widen_outline(mask: Mask) -> np.ndarray:
    """Return the outline shifted by half a voxel to both sides (n, 3) [m], so that one slice also has a convex hull."""
    half = 0.5 * mask.affine[:3, :3].sum(axis=1)
    return np.concatenate([mask.outline - half, mask.outline + half])


def _compute_fraction_within(planes: np.ndarray, points: np.ndarray) -> float:
    """Return the fraction of points (n, 3) that are inside all planes of a convex hull."""
    outermost = np.full(len(points), -np.inf)
    for part in np.array_split(planes, max(1, len(planes) // 64)):
        np.maximum(outermost, (points @ part[:, :3].T + part[:, 3]).max(axis=1), out=outermost)
    return float((outermost <= 0.0).mean())


def _format_box(box: np.ndarray) -> str:
    low, high = (", ".join(f"{1e3 * value:.0f}" for value in end) for end in box)
    return f"{low} to {high} mm (RAS)"
