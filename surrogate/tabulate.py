"""Tabulating the finite elements' series: where, how wide and in which directions they are asked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim.fem import Fem
from sim.loads import Loads, Pushed

from .encode import Basis
from .patch import Patch
from .series import ORDERS, SPANS, STENCIL, TERMS, Series, forms

# The ten axes of a dodecahedron tell any form of the third degree.
GOLDEN = 0.5 * (1.0 + np.sqrt(5.0))
AXES = np.array(
    [(1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)]
    + [
        axis
        for sign in (1.0, -1.0)
        for axis in ((0, 1 / GOLDEN, sign * GOLDEN), (sign * GOLDEN, 0, 1 / GOLDEN), (1 / GOLDEN, sign * GOLDEN, 0))
    ]
)
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
    patch: Patch,
    radii: np.ndarray,
    nodes: np.ndarray,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> np.ndarray:
    """What `forms` are multiplied by at each place of `with_middles` and each radius: (P, R, 19, n, 3) float32.

    For the responses of vertices `nodes` (n,); `progress` hears places done and all.
    """
    places = with_middles(patch)[1]
    directions = AXES / np.linalg.norm(AXES, axis=1, keepdims=True)
    solver = [np.linalg.pinv(forms(directions, np.ones(len(directions)))[:, rows]) for rows in SPANS]
    table = np.zeros((len(places), len(radii), TERMS, len(nodes), 3), np.float32)
    some = max(1, fem.batch // (len(radii) * len(directions)))
    for first in range(0, len(places), some):
        here = places[first : first + some]
        shape = (len(here), len(radii), len(directions))
        point = np.broadcast_to(here[:, None, None], (*shape, 3)).reshape(-1, 3)
        force = np.broadcast_to(directions, (*shape, 3)).reshape(-1, 3)
        radius = np.broadcast_to(radii[:, None], shape).reshape(-1)
        found = fem.series(Loads((Pushed(point, force, radius),)), ORDERS, nodes).astype(np.float32)
        for order, span in enumerate(SPANS):
            answers = found[order].reshape(*shape, len(nodes), 3)
            table[first : first + some, :, span] = np.einsum("td,prdnk->prtnk", solver[order], answers)
        progress(min(first + some, len(places)), len(places))
    return table


def series_of(table: np.ndarray, nodes: np.ndarray, patch: Patch, radii: np.ndarray, basis: Basis) -> Series:
    """A table of `tabulated` for sorted vertices `nodes` (n,), as coefficients of a basis of some of them."""
    known = table[:, :, :, np.searchsorted(nodes, basis.nodes)]
    coefficients = known.reshape(*table.shape[:3], -1) @ basis.modes.T
    exact = Series(patch.points, with_middles(patch)[0], radii, coefficients)
    return Series.restored(exact.state())  # what is used is what can be stored


def with_middles(patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (S, 6) with the middle of the edge opposite each corner, and the places (P, 3) [m] that they number."""
    edges = np.sort(patch.triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    triangles = np.column_stack([patch.triangles, len(patch.points) + middle.reshape(-1, 3)])
    return triangles, np.concatenate([patch.points, patch.points[ends].mean(axis=1)])
