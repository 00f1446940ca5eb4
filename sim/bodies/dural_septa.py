"""Falx and tentorium as walls: which nodes of a mesh do not move, so that none of its edges passes a sheet of dura.

Dural septa act as rigid membranes: Chen et al. 2011, IEEE Trans. Biomed. Eng. 58:499-508 (PMC3864010). Here tissue is
bonded to them, and does not slide along them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, KDTree

from ..errors import InputError
from ..geometry.tetmesh import EDGES, TetMesh, compute_row_keys

SEPTA = ("falx", "tentorium")
"""Their names."""
# Places of an edge that are held against a sheet, at least and at most.
FEWEST, MOST = 5, 200
SHALLOWEST, DEEPEST = 10e-3, 60e-3
"""[m] Of a falx that is drawn."""
SPACING = 1e-3
"""[m] Of the points of a falx that is drawn."""


@dataclass(frozen=True, eq=False)
class Septum:
    """A sheet of dura: centres (n, 3) [m] of its voxels, and half of their diagonal [m]; balls of that hold them."""

    name: str
    points: np.ndarray
    reach: float


def synthesise_falx(cortex: np.ndarray, depth: float) -> Septum:
    """Return a falx in the midline of a head that has none, from points (n, 3) [m, RAS] of its surface.

    It hangs from the convexity by a `depth` [m], the same everywhere, and ends at half of the head's height. A real
    one is narrow in front and wide behind. The outline of the head is convex, as the skull is, and sulci are ignored.

    Raises
    ------
    InputError
        A depth outside 10 to 60 mm.
    """
    if not SHALLOWEST <= depth <= DEEPEST:
        raise InputError(
            f"a falx of {1e3 * depth:g} mm is outside {1e3 * SHALLOWEST:g} to {1e3 * DEEPEST:g} mm: "
            "choose a depth between."
        )
    low, high = cortex.min(axis=0), cortex.max(axis=0)
    middle = 0.5 * (low + high)
    y, z = np.meshgrid(np.arange(low[1], high[1], SPACING), np.arange(middle[2], high[2], SPACING), indexing="ij")
    side = np.column_stack([y.ravel(), z.ravel()])
    outline = ConvexHull(cortex[:, 1:]).equations
    under = -(side @ outline[:, :2].T + outline[:, 2]).max(axis=1)
    sheet = side[(under >= 0.0) & (under <= depth)]
    return Septum("falx", np.column_stack([np.full(len(sheet), middle[0]), sheet]), np.sqrt(0.5) * SPACING)


def find_held_vertices(mesh: TetMesh, septum: Septum) -> np.ndarray:
    """Which vertices (V,) bool a sheet holds: of each edge that meets it, the end that is nearer to where it does.

    Of every tetrahedron through which the sheet goes, each edge that it cuts has then an end that does not move.
    """
    ends = np.sort(mesh.tets[:, EDGES].reshape(-1, 2))
    _, first = np.unique(compute_row_keys(ends), return_index=True)
    ends = ends[first]
    tree, corners = KDTree(septum.points), mesh.nodes[ends]
    length = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    near = tree.query(corners.mean(axis=1), distance_upper_bound=0.5 * length.max() + septum.reach)[0]
    close = near <= 0.5 * length + septum.reach
    held = np.zeros(len(mesh.nodes), bool)
    if not close.any():
        return held
    ends, corners = ends[close], corners[close]
    count = int(np.clip(np.ceil(length[close].max() / septum.reach), FEWEST, MOST))
    along = np.linspace(0.0, 1.0, count)
    places = corners[:, :1] + along[:, None] * (corners[:, 1:] - corners[:, :1])
    distance = tree.query(places.reshape(-1, 3), distance_upper_bound=septum.reach)[0].reshape(places.shape[:2])
    inside = np.isfinite(distance)
    meets = inside.any(axis=1)
    where = (inside[meets] * along).sum(axis=1) / inside[meets].sum(axis=1)
    held[ends[meets, (where > 0.5).astype(int)]] = True
    return held
