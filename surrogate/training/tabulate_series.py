"""Tabulating the finite elements' series: where and how wide they are asked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim.fem import Fem
from sim.geometry.surface import edge_lengths
from sim.loads import Loads, Pushed
from sim.minimisers.power_series import Reading
from sim.runtime.journal import Journal

from ..array_functions import squared_distances
from ..data.cortex_patch import Patch
from ..regressors.force_series import FACTORS, ORDERS, STENCIL, TERMS

# Neighbouring radii differ by this factor at most.
RATIO = 1.5


def radii_between(least: float, greatest: float) -> np.ndarray:
    """Radii [m] at which to tabulate footprints from `least` to `greatest`: one, or at least three."""
    if greatest <= least * (1.0 + 1e-9):
        return np.array([least])
    steps = int(np.ceil(np.log(greatest / least) / np.log(RATIO)))
    return np.geomspace(least, greatest, max(STENCIL, steps + 1))


def tabulated(
    fem: Fem,
    places: np.ndarray,
    radii: np.ndarray,
    reading: Reading,
    progress: Callable[[int, int], object] = lambda done, total: None,
    journal: Journal | None = None,
) -> np.ndarray:
    """What `forms` are multiplied by at each of the places (P, 3) [m] and each radius: (P, R, 19, r) float32.

    Of the r shares that a `reading` takes of the answers; `progress` hears places done and all. Places that the
    `journal` has are not asked again.
    """
    table = np.empty((len(places), len(radii), TERMS, reading.count), np.float32)
    some = max(1, fem.batch // (len(radii) * FACTORS[-1].shape[1]))
    left = []
    for number, row in enumerate(table):
        if journal is None or ("row", number) not in journal:
            left.append(number)
        else:
            row[:] = np.frombuffer(journal.read(("row", number)), table.dtype).reshape(row.shape)
    for first in range(0, len(left), some):
        rows = left[first : first + some]
        here = places[rows]
        point = np.repeat(here, 3 * len(radii), axis=0)
        force = np.tile(np.eye(3), (len(here) * len(radii), 1))
        loads = Loads((Pushed(point, force, np.tile(np.repeat(radii, 3), len(here))),))
        table[rows] = fem.series(loads, ORDERS, reading, 3).reshape(len(here), *table.shape[1:])
        if journal is not None:
            for number in rows:
                journal.add(("row", number), table[number].tobytes())
        progress(len(places) - len(left) + first + len(here), len(places))
    return table


def in_one_disc(patch: Patch, radius: float) -> np.ndarray:
    """Which nodes (m, m) bool a disc of a radius [m], or a triangle and its neighbours, may bear at once.

    Triangles reach into a disc from nodes that are farther apart, but of the tumour's motion these do 1 in 100,000.
    """
    longest = edge_lengths(patch.points[patch.triangles]).max()
    return squared_distances(patch.points, patch.points) <= (2.0 * max(radius, longest)) ** 2


def with_middles(patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (S, 6) with the middle of the edge opposite each corner, and the places (P, 3) [m] that they number."""
    edges = np.sort(patch.triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    triangles = np.column_stack([patch.triangles, len(patch.points) + middle.reshape(-1, 3)])
    return triangles, np.concatenate([patch.points, patch.points[ends].mean(axis=1)])
