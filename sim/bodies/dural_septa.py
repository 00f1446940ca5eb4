"""Falx and tentorium as rigid walls: nodes at a dural sheet are fixed so that every edge across it has a fixed end.

Dural septa act as rigid membranes: Chen et al. 2011, IEEE Trans. Biomed. Eng. 58:499-508 (PMC3864010). In this model
tissue is bonded to the septa and does not slide along them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, KDTree

from ..errors import InputError
from ..geometry.tetmesh import EDGES, TetMesh, compute_row_keys

SEPTA = ("falx", "tentorium")
"""Names of the septa."""
MIN_SAMPLES = 5  # minimum sample points per mesh edge, in the test against a sheet
MAX_SAMPLES = 200  # maximum sample points per mesh edge
MIN_FALX_DEPTH = 10e-3
"""Minimum depth of a synthetic falx [m]."""
MAX_FALX_DEPTH = 60e-3
"""Maximum depth of a synthetic falx [m]."""
SPACING = 1e-3
"""Point spacing of a synthetic falx [m]."""


@dataclass(frozen=True, eq=False)
class Septum:
    """Sheet of dura: `name`, voxel centres `points` (n, 3) [m], and `radius` [m] of balls at them that cover it."""

    name: str
    points: np.ndarray
    radius: float


def synthesise_falx(cortex: np.ndarray, depth: float) -> Septum:
    """Return a synthetic falx in the midline of a head, given points (n, 3) [m, RAS] on the cortex.

    The falx extends inwards from the convexity by a constant `depth` [m] and ends at half of the head's height; a real
    falx is narrow in front and wide behind. The convex outline of the points is used, so sulci are ignored.

    Raises
    ------
    InputError
        The depth is outside 10 to 60 mm.
    """
    if not MIN_FALX_DEPTH <= depth <= MAX_FALX_DEPTH:
        raise InputError(
            f"a falx of {1e3 * depth:g} mm is outside {1e3 * MIN_FALX_DEPTH:g} to {1e3 * MAX_FALX_DEPTH:g} mm: "
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


def find_fixed_vertices(mesh: TetMesh, septum: Septum) -> np.ndarray:
    """Return a mask (V,) of the vertices to fix: for each edge that crosses the sheet, the end nearer to the crossing.

    Every mesh edge that crosses the sheet therefore has at least one fixed end.
    """
    ends = np.sort(mesh.tets[:, EDGES].reshape(-1, 2))
    _, first = np.unique(compute_row_keys(ends), return_index=True)
    ends = ends[first]
    tree, corners = KDTree(septum.points), mesh.nodes[ends]
    length = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    near = tree.query(corners.mean(axis=1), distance_upper_bound=0.5 * length.max() + septum.radius)[0]
    close, fixed = near <= 0.5 * length + septum.radius, np.zeros(len(mesh.nodes), bool)
    if not close.any():
        return fixed
    ends, corners = ends[close], corners[close]
    count = int(np.clip(np.ceil(length[close].max() / septum.radius), MIN_SAMPLES, MAX_SAMPLES))
    along = np.linspace(0.0, 1.0, count)
    places = corners[:, :1] + along[:, None] * (corners[:, 1:] - corners[:, :1])
    distance = tree.query(places.reshape(-1, 3), distance_upper_bound=septum.radius)[0].reshape(places.shape[:2])
    inside = np.isfinite(distance)
    meets = inside.any(axis=1)
    where = (inside[meets] * along).sum(axis=1) / inside[meets].sum(axis=1)
    fixed[ends[meets, (where > 0.5).astype(int)]] = True
    return fixed
