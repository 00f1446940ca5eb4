"""Extension of a field outside its domain: the nearest known value, which fades to zero with distance."""

import numpy as np
from scipy import ndimage

# Smoothing iterations on filled nodes, against jumps where two known nodes are equally near.
SMOOTHING_ITERATIONS = 6


def extend_field(field: np.ndarray, mask: np.ndarray, max_distance: float) -> np.ndarray:
    """Fill the nodes of a field (3, I, J, K) outside `mask` (I, J, K); zero beyond `max_distance` [nodes].

    A filled node has the nearest known value, reduced with the distance; then the filled nodes are smoothed. Their
    values do not exceed the known values. The field is changed in place.
    """
    filled = np.where(mask, field, np.float32(0.0))
    moving = np.argwhere(filled.any(axis=0))
    if not len(moving):
        return filled
    away = int(np.ceil(max_distance)) + SMOOTHING_ITERATIONS
    low, high = np.maximum(moving.min(axis=0) - away, 0), moving.max(axis=0) + away + 1
    window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    _fill_field(filled[(slice(None), *window)], mask[window], max_distance)
    return filled


def _fill_field(field: np.ndarray, mask: np.ndarray, max_distance: float) -> None:
    """Fill a field in place, as `extend_field`; known nonzero nodes are more than `max_distance` from the border."""
    nearest = np.empty((3, *mask.shape), np.int32)
    ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True, indices=nearest)
    square = np.zeros(mask.shape, np.int32)  # squared distance; SciPy's distances take twice the time and memory
    for at, side in zip(nearest, np.indices(mask.shape, np.int32, sparse=True), strict=True):
        step = at - side
        square += step * step
    free = (square > 0) & (square < max_distance * max_distance)
    source, left = tuple(nearest[:, free]), 1.0 - np.sqrt(square[free]) / max_distance
    fade = (left * left * (3.0 - 2.0 * left)).astype(np.float32)
    for part in field:
        part[free] = fade * part[source]
    smooth_field(field, free, SMOOTHING_ITERATIONS)


def smooth_field(field: np.ndarray, mask: np.ndarray, iterations: int) -> None:
    """Replace nodes marked in `mask` (I, J, K) by the mean of their neighbours, `iterations` times; not at the border.

    The field (3, I, J, K) is changed in place.
    """
    middle, inner = slice(1, -1), mask[1:-1, 1:-1, 1:-1]
    total = np.empty(inner.shape, field.dtype)
    for part in field:
        for _ in range(iterations):
            np.add(part[:-2, middle, middle], part[2:, middle, middle], out=total)
            total += part[middle, :-2, middle]
            total += part[middle, 2:, middle]
            total += part[middle, middle, :-2]
            total += part[middle, middle, 2:]
            total *= field.dtype.type(1.0 / 6.0)
            np.copyto(part[middle, middle, middle], total, where=inner)
