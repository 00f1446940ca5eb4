"""Footprint of a round tool on a triangulated surface: distribution of its force over the vertices.

The traction w(s) = sqrt(1 - s^2), s = |x - c| / r, is the Hertz pressure of a smooth indenter. It is integrated over
triangles, which are subdivided until they are small compared with the footprint. Force and moment are then
independent of the mesh.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..errors import InputError
from ..loads import Displaced, Loads, Pushed
from ..runtime.device import Device, find_device, forward_kernel

# Triangles per search thread, and candidates per reduction thread.
CHUNK = wp.constant(16)

vec6d = wp.types.vector(length=6, dtype=wp.float64)  # numbers of a quadratic triangle


@dataclass(frozen=True)
class EdgeSubdivision:
    """Subdivision of triangle edges under a footprint.

    Parameters
    ----------
    max_edge_ratio
        Maximum edge length after subdivision, as a fraction of the footprint radius.
    min_subdivisions
        Initial number of subdivisions per edge, which is doubled until `max_edge_ratio` is reached.
    max_subdivisions
        Maximum number of subdivisions per edge; the default suffices for a footprint of 0.1 mm on a triangle of 50 m.
    """

    max_edge_ratio: float = 0.12
    min_subdivisions: int = 8
    max_subdivisions: int = 2**22


@dataclass(frozen=True, eq=False)
class Footprints:
    """Footprints of B tools on M nodes: a tool force F adds the force F x weight / total to every node.

    `nodes` (M,): node numbers. On the device, `weight` (M, B) float64 and `sums` (B,) of 4-vectors: total weight, and
    sum of weight x position [m].
    """

    nodes: np.ndarray
    weight: wp.array
    sums: wp.array

    def to_matrix(self, count: int) -> sp.csr_array:
        """Return normalised weights (B, `count`) of all nodes of a mesh; the sum of each row is 1."""
        weight, total = self.weight.numpy().T, self.sums.numpy().reshape(-1, 4)[:, 0]
        tool, place = np.nonzero(weight)
        share = weight[tool, place] / total[tool]
        return sp.csr_array((share, (tool, self.nodes[place])), shape=(len(weight), count))

    def compute_centres(self) -> np.ndarray:
        """Return the points (B, 3) [m] at which the tool forces act, the weighted centroids of the footprints."""
        sums = self.sums.numpy().reshape(-1, 4)
        return sums[:, 1:] / sums[:, :1]


@dataclass(frozen=True, eq=False)
class FootprintArrays:
    """Device arrays for B footprints: `tools` (B,) as point and radius [m], `contact_points` (B,) with distance.

    `levels` (n, B) are reduction levels of the nearest points; `weight` (M, B) and `sums` (B,) are as in `Footprints`.
    """

    tools: wp.array
    contact_points: wp.array
    levels: tuple[wp.array, ...]
    weight: wp.array
    sums: wp.array


class ContactSurface:
    """Triangulated surface for tool contact, on a device.

    Parameters
    ----------
    nodes
        Nodes (N, 3) [m].
    triangles
        Triangles (S, 3), or quadratic (S, 6) with midpoints of `TRIANGLE_EDGES`; edges are treated as straight.
    device
        Device of the arrays.
    name
        Name for messages.
    subdivision
        Subdivision of the triangles under a footprint.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        triangles: np.ndarray,
        device: Device,
        name: str = "surface",
        subdivision: EdgeSubdivision = EdgeSubdivision(),
    ):
        self.device, self._name, self._division = device, name, subdivision
        self.nodes, table = np.unique(triangles, return_inverse=True)
        self.numbers = device.upload(self.nodes, wp.int32)
        corners = nodes[triangles[:, :3]]
        centre = corners.mean(axis=1)
        reach = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
        edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(initial=0.0)
        self._least = edge / (subdivision.max_edge_ratio * subdivision.max_subdivisions)
        self._corners = device.upload(corners, wp.vec3d)
        self._ball = device.upload(np.column_stack([centre, reach]), wp.vec4d)
        self._table = device.upload(table.reshape(triangles.shape), wp.int32)
        self._position = device.upload(nodes[self.nodes], wp.vec3d)
        self._last: tuple[bytes, Footprints] | None = None

    def find_nearest(self, points: np.ndarray, max_distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the surface point nearest to each of B points [m], and its distance, inf if > `max_distance` (B,)."""
        imprint = self.allocate_footprints(self._pack_tools(points, max_distance))
        self._find_contacts(imprint)
        touched = imprint.contact_points.numpy().reshape(-1, 4)
        return touched[:, :3], touched[:, 3]

    def find_footprints(self, points: np.ndarray, radii: np.ndarray) -> Footprints:
        """Return the footprints of tools at `points` (B, 3) with `radii` (B,) [m].

        A point outside the surface is moved to the nearest surface point, by at most its radius. The last result is
        cached, since a solve requests the footprints of the same tools more than once.

        Raises
        ------
        InputError
            A footprint does not touch the surface, or is too small for the maximum subdivision of the triangles.
        """
        key, last = np.column_stack([points, radii]).tobytes(), self._last
        if last is None or last[0] != key:
            last = self._last = key, self._compute_footprints(points, radii)
        return last[1]  # another thread may have replaced self._last since

    def allocate_footprints(self, tools: wp.array) -> FootprintArrays:
        """Return allocated footprint arrays for `tools` (B,)."""
        count, device = len(tools), self.device.name
        found, left = [], len(self._ball)
        while left > 1 or not found:
            left = -(-left // CHUNK)
            found.append(wp.empty((left, count), dtype=wp.vec4d, device=device))
        sums = wp.empty(count, dtype=wp.vec4d, device=device)
        weight = wp.empty((len(self.nodes), count), dtype=wp.float64, device=device)
        return FootprintArrays(tools, found[-1].flatten(), tuple(found), weight, sums)

    def compute_footprints(self, footprints: FootprintArrays) -> None:
        """Compute the footprints in place, on the device; a tool without contact has distance inf and weight 0."""
        self._find_contacts(footprints)
        footprints.weight.zero_()
        footprints.sums.zero_()
        inputs = [self._corners, self._ball, self._table, self._position, footprints.tools, footprints.contact_points]
        inputs += [self._division.max_edge_ratio, self._division.min_subdivisions, self._division.max_subdivisions]
        self.device.launch(
            _integrate_footprint, (len(self._ball), len(footprints.tools)), inputs, [footprints.weight, footprints.sums]
        )

    def check_contact(self, points: np.ndarray, radii: np.ndarray) -> None:
        """Reject tools at `points` (B, 3) with `radii` (B,) [m] if a tool does not touch the surface.

        Raises
        ------
        InputError
            A tool does not touch the surface; the message describes the first such tool.
        """
        self._check_touching(points, radii, self.find_nearest(points, radii)[1])

    def _compute_footprints(self, points: np.ndarray, radii: np.ndarray) -> Footprints:
        small = radii.min(initial=np.inf)
        if small < self._least:
            raise InputError(
                f"a footprint of {1e3 * small:.3g} mm is too small for the triangles of this surface: give a radius of "
                f"at least {1e3 * self._least:.3g} mm."
            )
        imprint = self.allocate_footprints(self._pack_tools(points, radii))
        self.compute_footprints(imprint)
        self._check_touching(points, radii, imprint.contact_points.numpy().reshape(-1, 4)[:, 3])
        return Footprints(self.nodes, imprint.weight, imprint.sums)

    def _check_touching(self, points: np.ndarray, radii: np.ndarray, distances: np.ndarray) -> None:
        """Reject tools whose `distances` (B,) from the surface are infinite."""
        missed = np.flatnonzero(np.isinf(distances))
        if len(missed):
            number = missed[0]
            raise InputError(
                f"load {number} presses at {np.round(1e3 * points[number], 1)} mm with a footprint of "
                f"{1e3 * radii[number]:.3g} mm, which does not touch the {self._name}: choose a point on it."
            )

    def _pack_tools(self, points: np.ndarray, radii: np.ndarray) -> wp.array:
        return self.device.upload(np.column_stack([points, radii]), wp.vec4d)

    def _find_contacts(self, footprints: FootprintArrays) -> None:
        """Find the contact point of each tool and its distance, which is inf if larger than the radius of the tool."""
        inputs = [self._corners, self._ball, footprints.tools]
        self.device.launch(_search_chunk, footprints.levels[0].shape, inputs, [footprints.levels[0]])
        for some, fewer in pairwise(footprints.levels):
            self.device.launch(_reduce_candidates, fewer.shape, [some], [fewer])


def compute_footprint_weights(
    nodes: np.ndarray, triangles: np.ndarray, points: np.ndarray, radii: np.ndarray
) -> sp.csr_array:
    """Return normalised footprint weights (B, N) of all nodes; the arguments are those of `ContactSurface`."""
    surface = ContactSurface(nodes, triangles, find_device("cpu", "float64"))
    return surface.find_footprints(points, radii).to_matrix(len(nodes))


def find_nearest_point(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the point (3,) on triangles with `corners` (S, 3, 3) [m] that is nearest to `point` (3,)."""
    apart = np.arange(3 * len(corners)).reshape(-1, 3)
    skin = ContactSurface(corners.reshape(-1, 3), apart, find_device("cpu", "float64"))
    return skin.find_nearest(point[None], np.array([np.inf]))[0][0]


@wp.func
def _find_on_edge(a: wp.vec3d, b: wp.vec3d, point: wp.vec3d) -> wp.vec3d:
    """Return the point on the segment a-b that is nearest to `point`."""
    edge = b - a
    square = wp.dot(edge, edge)
    along = wp.float64(0.0)
    if square > wp.float64(0.0):
        along = wp.clamp(wp.dot(point - a, edge) / square, wp.float64(0.0), wp.float64(1.0))
    return a + along * edge


@wp.func
def _select_nearer(a: wp.vec3d, b: wp.vec3d, point: wp.vec3d) -> wp.vec3d:
    """Return `a` or `b`, the point that is nearer to `point`."""
    return wp.where(wp.length_sq(a - point) <= wp.length_sq(b - point), a, b)


@wp.func
def find_nearest_on_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, point: wp.vec3d) -> wp.vec3d:
    """Return the point on the triangle a, b, c that is nearest to `point`.

    Ericson 2005, "Real-Time Collision Detection", section 5.1.5: the projection onto the plane if it is inside the
    triangle, else the nearest point of the edges. For degenerate triangles only the edges are used.
    """
    nearest = _select_nearer(
        _select_nearer(_find_on_edge(a, b, point), _find_on_edge(b, c, point), point), _find_on_edge(c, a, point), point
    )
    first, second, offset = b - a, c - a, point - a
    # barycentric coordinates of the projection from the Gram matrix of two edges
    aa, ab, bb = wp.dot(first, first), wp.dot(first, second), wp.dot(second, second)
    pa, pb = wp.dot(offset, first), wp.dot(offset, second)
    area = aa * bb - ab * ab
    v, w = bb * pa - ab * pb, aa * pb - ab * pa
    if area > wp.float64(0.0) and v >= wp.float64(0.0) and w >= wp.float64(0.0) and v + w <= area:
        nearest = _select_nearer(a + (v / area) * first + (w / area) * second, nearest, point)
    return nearest


@wp.func
def _get_centre(ball: wp.vec4d) -> wp.vec3d:
    """Return the centre of a ball or the point of a tool, the first three components; the fourth one is the radius."""
    return wp.vec3d(ball[0], ball[1], ball[2])


@wp.func
def _pack_candidate(point: wp.vec3d, distance: wp.float64) -> wp.vec4d:
    return wp.vec4d(point[0], point[1], point[2], distance)


@forward_kernel
def _search_chunk(
    corners: wp.array2d(dtype=wp.vec3d),
    balls: wp.array(dtype=wp.vec4d),
    tools: wp.array(dtype=wp.vec4d),
    # outputs
    candidates: wp.array2d(dtype=wp.vec4d),
):
    """Find the nearest point on a chunk of triangles and its distance; inf if no point is in range."""
    chunk, c = wp.tid()
    point = _get_centre(tools[c])
    best = tools[c][3]
    candidates[chunk, c] = _pack_candidate(point, wp.float64(wp.inf))
    for s in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, balls.shape[0])):
        near = balls[s][3] + best
        if wp.length_sq(_get_centre(balls[s]) - point) <= near * near:
            nearest = find_nearest_on_triangle(corners[s, 0], corners[s, 1], corners[s, 2], point)
            far = wp.length(nearest - point)
            if far <= best:
                best = far
                candidates[chunk, c] = _pack_candidate(nearest, far)


@forward_kernel
def _reduce_candidates(
    candidates: wp.array2d(dtype=wp.vec4d),
    # outputs
    nearest: wp.array2d(dtype=wp.vec4d),
):
    """Reduce each group of candidate points to the nearest one."""
    group, c = wp.tid()
    best = candidates[group * CHUNK, c]
    for k in range(1, CHUNK):
        other = candidates[wp.min(group * CHUNK + k, candidates.shape[0] - 1), c]
        if other[3] < best[3]:
            best = other
    nearest[group, c] = best


@forward_kernel
def _integrate_footprint(
    corners: wp.array2d(dtype=wp.vec3d),
    balls: wp.array(dtype=wp.vec4d),
    triangles: wp.array2d(dtype=wp.int32),
    positions: wp.array(dtype=wp.vec3d),
    tools: wp.array(dtype=wp.vec4d),
    contacts: wp.array(dtype=wp.vec4d),
    max_edge_ratio: wp.float64,
    min_subdivisions: int,
    max_subdivisions: int,
    # outputs
    weights: wp.array2d(dtype=wp.float64),
    sums: wp.array(dtype=wp.vec4d),
):
    """Add the integral of w N_a over a triangle, up to a constant factor, from the centroids of n^2 equal parts.

    In a row of parts with constant y, part j is inside the footprint if A j^2 + 2 B j + C < 0, an interval of j.
    """
    s, c = wp.tid()
    point, radius = _get_centre(contacts[c]), tools[c][3]
    near = balls[s][3] + radius
    if wp.length_sq(_get_centre(balls[s]) - point) > near * near:
        return
    zero, one, two = wp.float64(0.0), wp.float64(1.0), wp.float64(2.0)
    start, first, second = corners[s, 0] - point, corners[s, 1] - corners[s, 0], corners[s, 2] - corners[s, 0]
    longest = wp.max(wp.max(wp.length(first), wp.length(second)), wp.length(first - second))
    n = int(min_subdivisions)
    while longest > max_edge_ratio * radius * wp.float64(n) and n < max_subdivisions:
        n *= 2
    h = one / wp.float64(n)
    step = h * second
    A = wp.length_sq(step)
    # Moments of w over the triangle in barycentric coordinates (1 - y - z, y, z): of 1, y, z, and of y^2, y z, z^2.
    m, mm = wp.vec3d(), wp.vec3d()
    # centroids: upright parts at 1/3, rotated parts at 2/3
    for turned in range(2):
        third = wp.float64(turned + 1) / wp.float64(3.0)
        for i in range(n - turned):
            b = (wp.float64(i) + third) * h
            at = start + b * first + third * step
            B = wp.dot(at, step)
            C = wp.length_sq(at) - radius * radius
            if B * B > A * C:
                root = wp.sqrt(B * B - A * C)
                low = int(wp.max((-B - root) / A, zero))
                high = int(wp.clamp((root - B) / A, -one, wp.float64(n - i - turned - 1)))
                row = wp.vec3d()
                for j in range(low, high + 1):
                    k = wp.float64(j)
                    a = (k + third) * h
                    row += wp.sqrt(wp.max(-((A * k + two * B) * k + C), zero)) * wp.vec3d(one, a, a * a)
                m += wp.vec3d(row[0], b * row[0], row[1])
                mm += wp.vec3d(b * b * row[0], b * row[1], row[2])
    if m[0] == zero:
        return
    scale = wp.length(wp.cross(first, second)) * h * h / radius
    x, y, z = m[0] - m[1] - m[2], m[1], m[2]
    share = vec6d(x, y, z, zero, zero, zero)
    if triangles.shape[1] == 6:  # L (2 L - 1) at corners, 4 L_i L_j at midpoints
        xy, yz, zx = y - mm[0] - mm[1], mm[1], z - mm[1] - mm[2]
        halves = vec6d(xy + zx, xy + yz, yz + zx, -two * xy, -two * yz, -two * zx)
        share -= two * halves
    moment = wp.vec3d()
    for a in range(triangles.shape[1]):
        wp.atomic_add(weights, triangles[s, a], c, scale * share[a])
        moment += share[a] * positions[triangles[s, a]]
    wp.atomic_add(sums, c, scale * wp.vec4d(m[0], moment[0], moment[1], moment[2]))


def compute_push_reactions(surface: ContactSurface, loads: Loads, tool_force: np.ndarray | None = None) -> np.ndarray:
    """Return force [N] and moment [N m] about the tool's point, for each pushing tool: (B, tools, 6).

    `tool_force` (3, B) [N] is the force of the `Displaced` load, if there is one.
    """
    rows = []
    for cause in loads.causes:
        if isinstance(cause, Pushed | Displaced):
            force = cause.force if isinstance(cause, Pushed) else tool_force
            assert force is not None
            force = force if isinstance(cause, Pushed) else force.T
            arm = surface.find_footprints(cause.point, cause.footprint).compute_centres() - cause.point
            rows.append(np.concatenate([force, np.cross(arm, force)], axis=1))
    return np.stack(rows, axis=1) if rows else np.zeros((len(loads), 0, 6))
