"""Tabulating the finite elements' series: where, how wide and in which directions they are asked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim.fem import Fem
from sim.loads import Loads, Pushed

from .encode import Basis
from .patch import Patch
from .series import ORDERS, SPANS, STENCIL, TERMS, Series, forms

# Ten axes that tell any form of the third degree, and none by much more than its own size.
AXES = np.array(
    [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1)]
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
    bases: tuple[Basis, ...],
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> tuple[Series, ...]:
    """One series for each basis, from the finite elements; `progress` hears places done and all."""
    triangles, places = with_middles(patch)
    directions = AXES / np.linalg.norm(AXES, axis=1, keepdims=True)
    solver = [np.linalg.pinv(forms(directions, np.ones(len(directions)))[:, rows]) for rows in SPANS]
    nodes = np.unique(np.concatenate([basis.nodes for basis in bases]))
    rows = [np.searchsorted(nodes, basis.nodes) for basis in bases]
    tables = [np.zeros((len(places), len(radii), TERMS, len(basis.modes)), np.float32) for basis in bases]
    some = max(1, fem.batch // (len(radii) * len(directions)))
    for first in range(0, len(places), some):
        here = places[first : first + some]
        shape = (len(here), len(radii), len(directions))
        point = np.broadcast_to(here[:, None, None], (*shape, 3)).reshape(-1, 3)
        force = np.broadcast_to(directions, (*shape, 3)).reshape(-1, 3)
        radius = np.broadcast_to(radii[:, None], shape).reshape(-1)
        found = fem.series(Loads((Pushed(point, force, radius),)), ORDERS, nodes).astype(np.float32)
        for table, basis, row in zip(tables, bases, rows, strict=True):
            for order, span in enumerate(SPANS):
                coefficients = basis.encode(found[order][:, row]).reshape(*shape, -1)
                table[first : first + some, :, span] = np.einsum("td,prdm->prtm", solver[order], coefficients)
        progress(min(first + some, len(places)), len(places))
    exact = (Series(patch.points, triangles, radii, table) for table in tables)
    return tuple(Series.restored(series.state()) for series in exact)  # what is used is what can be stored


def with_middles(patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (S, 6) with the middle of the edge opposite each corner, and the places (P, 3) [m] that they number."""
    edges = np.sort(patch.triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    triangles = np.column_stack([patch.triangles, len(patch.points) + middle.reshape(-1, 3)])
    return triangles, np.concatenate([patch.points, patch.points[ends].mean(axis=1)])
