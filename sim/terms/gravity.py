"""Change of weight since the scan, due to another posture or another fluid level."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import warp as wp

from ..discretisation.element import EIGHT_POINTS, EIGHT_WEIGHTS, compute_quadratic_gradients, compute_quadratic_shapes
from ..discretisation.space import Discretisation
from ..effects import Gravity
from ..geometry.surface import normalise_vectors
from ..geometry.tetmesh import QUADRATIC_EDGES
from ..loads import Loads, Posture
from ..runtime.device import Device
from .dead_force import DeadForce, NodalForces

STANDARD_GRAVITY = 9.80665  # [m/s^2]


def build_gravity_term(effect: Gravity, space: Discretisation, device: Device) -> DeadForce:
    """Return the term of `Gravity` on the nodes of `space`: dead loads, the current weight minus that in the scan."""
    return DeadForce("gravity", build_weight_change(effect, space, device), device)


def build_weight_change(
    effect: Gravity, space: Discretisation, device: Device, cache_size: int = 64
) -> Callable[[Loads], NodalForces | None]:
    """Return a function that returns nodal forces f_a = s (w_a(now) - w_a(scan)) of loads, or None without a `Posture`.

    s is the share of the posture, and w_a = g d integral of (rho - rho_csf [x is below the level]) N_a(x) dV, with
    gravity direction d and shape functions N_a in the undeformed configuration. The part of an element below the level
    is cut out exactly: the total is g d (rho V - rho_csf V_under), and forces are continuous in the level. Curved
    elements are cut as if their edges were straight. The weights of the last `cache_size` postures are cached, since a
    solver uses the same loads several times.
    """
    table, count = space.table, space.count
    ones = np.broadcast_to(np.eye(4), (len(table), 4, 4))
    whole = integrate_nodal_volumes(space, np.arange(len(table)), ones)
    volume = sum_by_node(table, whole, count)

    @lru_cache(cache_size)
    def compute_weights(*posture: float) -> np.ndarray:
        """Return the weight (N, 3) [N] of each node in a posture, given by the direction and the level [m]."""
        direction, level = np.array(posture[:3]), posture[3]
        height = (-space.nodes @ direction - level)[table[:, :4]]
        corners_under = (height < 0.0).sum(axis=1)
        full, cut = corners_under == 4, np.flatnonzero((corners_under > 0) & (corners_under < 4))
        owner, parts = cut_below_plane(height[cut])
        volumes = np.concatenate([whole[full], integrate_nodal_volumes(space, cut[owner], parts)])
        under = sum_by_node(np.concatenate([table[full], table[cut[owner]]]), volumes, count)
        mass = effect.density * volume - effect.csf_density * under
        return STANDARD_GRAVITY * mass[:, None] * direction

    def compute_forces(loads: Loads) -> NodalForces | None:
        cause = loads.get(Posture)
        if cause is None:
            return None
        scan = compute_weights(*normalise_gravity(np.array([effect.direction]))[0], effect.csf_level)
        postures = np.column_stack([normalise_gravity(cause.direction), cause.csf_level]).tolist()
        now = [compute_weights(*row) for row in postures]
        change = cause.share[:, None, None] * (np.reshape(now, (-1, count, 3)) - scan)
        return NodalForces(device.upload(np.arange(count), wp.int32), device.upload(change.reshape(-1, 3 * count).T))

    return compute_forces


def normalise_gravity(direction: np.ndarray) -> np.ndarray:
    """Return nonzero directions (B, 3), normalised to unit length."""
    return normalise_vectors(direction / np.abs(direction).max(axis=1, keepdims=True))


def integrate_nodal_volumes(space: Discretisation, owner: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Return integrals (m, n) [m^3] of the shape functions of the tetrahedra `owner` (m,) over parts of these.

    `parts` (m, 4, 4) are barycentric coordinates of the corners of each part. The eight-point rule of degree 3 is exact
    for straight elements, and for the volume of curved elements.
    """
    points = EIGHT_POINTS @ parts
    weight = np.abs(np.linalg.det(parts))[:, None] * EIGHT_WEIGHTS
    if space.table.shape[1] == 4:
        return space.mesh.volumes[owner, None] * np.einsum("mq,mqa->ma", weight, points)
    shape = compute_quadratic_shapes(points, QUADRATIC_EDGES)
    slope = compute_quadratic_gradients(points.reshape(-1, 4)).reshape(*shape.shape, 3)
    jacobian = np.einsum("mai,mqaj->mqij", space.nodes[space.table[owner]], slope)
    return np.einsum("mq,mqa->ma", weight * np.linalg.det(jacobian) / 6.0, shape)


def sum_by_node(table: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return the sums (N,) by node of `values` (m, n) at the nodes in `table` (m, n)."""
    return np.bincount(table.ravel(), values.ravel(), count)


# Corners of the part below the plane lie on edges of the tetrahedron, whose corners are sorted by height: (i, j) is the
# intersection of the plane with edge i-j, and (i, i) is corner i. Keys: number of corners below the plane.
CUT_CORNERS = {
    1: np.array([[0, 0], [0, 1], [0, 2], [0, 3]]),
    2: np.array([[0, 0], [0, 2], [0, 3], [1, 1], [1, 2], [1, 3]]),
    3: np.array([[0, 0], [1, 1], [2, 2], [0, 3], [1, 3], [2, 3]]),
}
# A prism between the triangles 0, 1, 2 and 3, 4, 5 consists of three tetrahedra.
PRISM = np.array([[0, 1, 2, 5], [0, 1, 4, 5], [0, 3, 4, 5]])
PART_TETS = {1: np.array([[0, 1, 2, 3]]), 2: PRISM, 3: PRISM}  # tetrahedra of the part, by number of corners below


def cut_below_plane(heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return disjoint tetrahedra that fill the part of each tetrahedron below a plane: owners and corners.

    `heights` (n, 4) [m] of the corners of n tetrahedra above the plane; one to three heights are negative. Return the
    original tetrahedron (m,) of each part, and the barycentric coordinates (m, 4, 4) of the corners of the part. The
    volume fraction of a part is |determinant|, which is continuous in the position of the plane.
    """
    order = np.argsort(heights, axis=1)
    corner, sorted_height = np.eye(4)[order], np.take_along_axis(heights, order, axis=1)
    under = (heights < 0.0).sum(axis=1)
    owners, parts = [np.zeros(0, int)], [np.zeros((0, 4, 4))]
    for count, ends in CUT_CORNERS.items():
        mine = np.flatnonzero(under == count)
        low, high = ends.T
        below, above = sorted_height[mine][:, low], sorted_height[mine][:, high]
        whole_way = np.where(low == high, 1.0, below - above)
        way = np.where(low == high, 0.0, below / whole_way)[:, :, None]
        points = (1.0 - way) * corner[mine][:, low] + way * corner[mine][:, high]
        found = points[:, PART_TETS[count]]
        owners.append(np.repeat(mine, found.shape[1]))
        parts.append(found.reshape(-1, 4, 4))
    return np.concatenate(owners), np.concatenate(parts)
