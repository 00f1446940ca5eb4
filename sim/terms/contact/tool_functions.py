"""Warp functions for contact between a surface triangle and a tool: forces, tangent stiffness and step bounds."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from ...runtime.device import Device
from .barrier import barrier, barrier_curvature, barrier_slope

# Maximum motion of a point per step, as a fraction of its distance from the tool's core.
MAX_STEP_FRACTION = 0.8
# Bound of a curved triangle's extent relative to its nodes' distance from the centre.
BULGE_BOUND = 1.5
# Distance between neighbouring points of a row, at most, times pieces / largest node distance from the corners'
# centroid: the sum of the shape functions' slopes.
SLOPE_SUMS = {3: 4.0 / 3.0, 6: 28.0 / 3.0}


@wp.struct
class Tools:
    """Data of T tools in b load cases: cores, as `tools.Core`, and their rotations and origins."""

    centre: wp.array(dtype=wp.vec3d)
    half: wp.array(dtype=wp.vec3d)
    radius: wp.array(dtype=wp.float64)
    rotation: wp.array2d(dtype=wp.mat33d)
    origin: wp.array2d(dtype=wp.vec3d)


@wp.struct
class Surface:
    """Data of surface triangles: undeformed node positions, node numbers, subdivisions per edge, and areas."""

    rest: wp.array(dtype=wp.vec3d)
    table: wp.array2d(dtype=wp.int32)
    pieces: wp.array(dtype=wp.int32)
    area: wp.array(dtype=wp.float64)


@wp.struct
class BarrierScale:
    """Width [m] and stiffness [Pa/m] of the barrier."""

    gap: wp.float64
    stiffness: wp.float64


@wp.struct
class ToolDistance:
    """Distance to a tool [m], with its gradient and its second derivative [1/m]."""

    distance: wp.float64
    normal: wp.vec3d
    curvature: wp.mat33d


@wp.func
def compute_core_distance(p: wp.vec3d, sizes: wp.vec3d, radius: wp.float64) -> ToolDistance:
    """Return the distance d = |v| - r to a core, v from the nearest point of the core to p, and two derivatives.

    These are n = v / |v| and dn = (M - n (x) n) / |v|; M selects the components in which p is outside the core.
    """
    one, zero = wp.float64(1.0), wp.float64(0.0)
    v, beyond = wp.vec3d(), wp.vec3d()
    for i in range(3):
        v[i] = p[i] - wp.clamp(p[i], -sizes[i], sizes[i])
        beyond[i] = wp.where(v[i] != zero or sizes[i] == zero, one, zero)
    length = wp.length(v)
    out = ToolDistance()
    out.distance = length - radius
    out.normal = wp.vec3d(zero, zero, -one)  # on the core itself: opposite to the shaft
    if length > zero:
        out.normal = v / length
        out.curvature = (wp.diag(beyond) - wp.outer(out.normal, out.normal)) / length
    return out


@wp.func
def compute_offset(clearance: wp.float64, spacing: wp.float64, max_offset: int) -> int:
    """Return the offset, 1 to `max_offset`, of the next point to test; each point lowers `clearance` by `spacing`."""
    out = wp.int32(1)
    if clearance > spacing:
        out = wp.int32(wp.min(clearance / spacing, wp.float64(max_offset)))
    return out


@wp.func
def compute_curvature(contact: ToolDistance, gap: wp.float64, definite: int) -> wp.mat33d:
    """Return b'' n (x) n + b' dn; if `definite`, only the first term, which is positive semi-definite."""
    out = barrier_curvature(contact.distance, gap) * wp.outer(contact.normal, contact.normal)
    if definite == 0:
        out += barrier_slope(contact.distance, gap) * contact.curvature
    return out


@dataclass(frozen=True)
class ToolFunctions:
    """Warp functions for triangles with `size` nodes; `forces` is the type of nodal vectors (size, 3).

    A triangle is sampled at the centroids of n^2 congruent parts in n rows, where n is the number of pieces per edge.
    Functions of a row sum over its points. They use the axes of a core (see `to_core_axes`), and skip points that are
    certainly outside the range of the core.
    """

    forces: Any
    get_motion: wp.Function
    get_positions: wp.Function
    to_core_axes: wp.Function
    add_forces: wp.Function
    get_stiffness: wp.Function
    bound_norm: wp.Function
    bound_spacing: wp.Function
    bound_distance: wp.Function
    is_near: wp.Function
    compute_shapes: wp.Function
    sum_row_energy: wp.Function
    sum_row_forces: wp.Function
    add_row_matrix: wp.Function
    bound_row_step: wp.Function


@cache
def build_functions(device: Device, size: int) -> ToolFunctions:
    """Return the functions for surface triangles with `size` nodes, 3 or 6.

    Positions and distances are in double precision on all devices, since gaps are small compared with the tissue.
    """
    scalar = device.scalar
    shares = wp.types.vector(length=size, dtype=wp.float64)
    forces = wp.types.matrix(shape=(size, 3), dtype=wp.float64)
    blocks = wp.types.matrix(shape=(3 * size * (size + 1) // 2, 3), dtype=wp.float64)
    bulge, kept = wp.constant(wp.float64(BULGE_BOUND if size == 6 else 1.0)), wp.constant(wp.float64(MAX_STEP_FRACTION))
    steep = wp.constant(wp.float64(SLOPE_SUMS[size]))

    @wp.func
    def compute_shapes(i: int, j: int, n: int) -> shares:
        """Return the shape functions at the centroid of part j in row i of n rows; odd parts are inverted triangles."""
        third, turned = wp.float64(1.0) / wp.float64(3 * n), j % 2
        y = wp.float64(3 * i + 1 + turned) * third
        z = wp.float64(3 * (j // 2) + 1 + turned) * third
        L = wp.vec3d(wp.float64(1.0) - y - z, y, z)
        out = shares()
        for a in range(3):
            if wp.static(size == 3):
                out[a] = L[a]
            else:
                out[a] = L[a] * (wp.float64(2.0) * L[a] - wp.float64(1.0))
                out[wp.static(size - 3) + a] = wp.float64(4.0) * L[a] * L[(a + 1) % 3]
        return out

    @wp.func
    def get_motion(surface: Surface, u: wp.array2d(dtype=scalar), s: int, c: int) -> forces:
        """Return the displacements of a triangle's nodes (size, 3)."""
        out = forces()
        for a in range(size):
            for k in range(3):
                out[a, k] = wp.float64(u[3 * surface.table[s, a] + k, c])
        return out

    @wp.func
    def get_positions(surface: Surface, u: wp.array2d(dtype=scalar), s: int, c: int) -> forces:
        """Return the deformed positions of a triangle's nodes (size, 3)."""
        out = get_motion(surface, u, s, c)
        for a in range(size):
            for k in range(3):
                out[a, k] += surface.rest[surface.table[s, a]][k]
        return out

    @wp.func
    def to_core_axes(x: forces, tools: Tools, k: int, c: int) -> forces:
        """Return positions relative to the centre of a core, along the axes of the core."""
        R = tools.rotation[k, c]
        start = tools.origin[k, c] + R * tools.centre[k]
        out = forces()
        for a in range(size):
            out[a] = wp.transpose(R) * (x[a] - start)
        return out

    @wp.func
    def add_forces(surface: Surface, total: forces, s: int, c: int, out: wp.array2d(dtype=scalar)):
        """Add the nodal forces of a triangle: f_a += total_a."""
        for a in range(size):
            for k in range(3):
                wp.atomic_add(out, 3 * surface.table[s, a] + k, c, scalar(total[a, k]))

    @wp.func
    def get_stiffness(surface: Surface, scale: BarrierScale, s: int) -> wp.float64:
        """Return the barrier stiffness times the area per sample point of a triangle [N/m]."""
        return scale.stiffness * surface.area[s] / wp.float64(surface.pieces[s] * surface.pieces[s])

    @wp.func
    def bound_norm(vectors: forces) -> wp.float64:
        """Return an upper bound of the norm over a triangle of an interpolated vector, from nodal vectors (size, 3)."""
        out = wp.float64(0.0)
        for a in range(size):
            out = wp.max(out, wp.length(vectors[a]))
        return bulge * out

    @wp.func
    def subtract_centroid(x: forces) -> forces:
        """Return the node positions (size, 3) relative to the centroid of the corners."""
        middle, out = wp.vec3d(), x
        for a in range(3):
            middle += x[a] / wp.float64(3.0)
        for a in range(size):
            out[a] = x[a] - middle
        return out

    @wp.func
    def bound_spacing(x: forces, n: int) -> wp.float64:
        """Return an upper bound of the distance between adjacent sample points of a row.

        Between these points, barycentric coordinates change by 1/3, 1/3 and 2/3 of a piece.
        """
        return steep * bound_norm(subtract_centroid(x)) / (bulge * wp.float64(n))

    @wp.func
    def bound_distance(x: forces, scale: wp.float64, sizes: wp.vec3d, radius: wp.float64) -> wp.float64:
        """Return a lower bound of the distance of a core from a triangle scaled by `scale` about its centroid."""
        arms = subtract_centroid(x)
        return compute_core_distance(x[0] - arms[0], sizes, radius).distance - scale * bound_norm(arms)

    @wp.func
    def is_near(x: forces, max_distance: wp.float64, sizes: wp.vec3d, radius: wp.float64) -> bool:
        """Return True if a point of the triangle may be within `max_distance` of a core."""
        return bound_distance(x, wp.float64(1.0), sizes, radius) < max_distance

    @wp.func
    def sum_row_energy(x: forces, n: int, i: int, sizes: wp.vec3d, radius: wp.float64, gap: wp.float64) -> wp.float64:
        """Return the sum of b(d) over the points of a row."""
        total, pace, most, j = wp.float64(0.0), bound_spacing(x, n), 2 * (n - i) - 1, wp.int32(0)
        while j < most:
            d = compute_core_distance(compute_shapes(i, j, n) * x, sizes, radius).distance
            total += barrier(d, gap)
            j += compute_offset(d - gap, pace, most)
        return total

    @wp.func
    def sum_row_forces(x: forces, n: int, i: int, sizes: wp.vec3d, radius: wp.float64, gap: wp.float64) -> forces:
        """Return the sum of N_a b'(d) n over the points of a row, for each node a."""
        total, pace, most, j = forces(), bound_spacing(x, n), 2 * (n - i) - 1, wp.int32(0)
        while j < most:
            N = compute_shapes(i, j, n)
            contact = compute_core_distance(N * x, sizes, radius)
            if contact.distance < gap:
                total += wp.outer(N, barrier_slope(contact.distance, gap) * contact.normal)
            j += compute_offset(contact.distance - gap, pace, most)
        return total

    @wp.func
    def add_row_matrix(
        x: forces,
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        definite: int,
        index: wp.array2d(dtype=wp.int32),
        s: int,
        i: int,
        k: int,
        c: int,
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add K_ab += sum over points of a row of w k H N_a N_b, between the nodes with `index` >= 0."""
        n, half, radius = surface.pieces[s], tools.half[k], tools.radius[k]
        total, touched, pace, most, j = blocks(), wp.bool(False), bound_spacing(x, n), 2 * (n - i) - 1, wp.int32(0)
        while j < most:
            N = compute_shapes(i, j, n)
            contact = compute_core_distance(N * x, half, radius)
            if contact.distance < scale.gap:
                touched = True
                H = compute_curvature(contact, scale.gap, definite)
                for a in range(size):
                    for b in range(size):
                        if b <= a:
                            for row in range(3):
                                q = 3 * (a * (a + 1) // 2 + b) + row
                                total[q] = total[q] + N[a] * N[b] * H[row]
            j += compute_offset(contact.distance - scale.gap, pace, most)
        if touched:
            R, weight = tools.rotation[k, c], get_stiffness(surface, scale, s)
            for a in range(size):
                first = 3 * index[surface.table[s, a], c]
                for b in range(size):
                    second, q = 3 * index[surface.table[s, b], c], 3 * (a * (a + 1) // 2 + b)
                    if b <= a and first >= 0 and second >= 0:
                        H = weight * (R * wp.matrix_from_rows(total[q], total[q + 1], total[q + 2]) * wp.transpose(R))
                        for row in range(3):
                            for column in range(3):
                                wp.atomic_add(out, c, first + row, second + column, H[row, column])
                                if a != b:
                                    wp.atomic_add(out, c, second + column, first + row, H[row, column])

    @wp.func
    def bound_row_step(x: forces, motion: forces, n: int, i: int, sizes: wp.vec3d, radius: wp.float64) -> wp.float64:
        """Return the fraction of a motion, at most 1, with which no point of a row reaches the centre of a core."""
        out, pace, most, j = wp.float64(1.0), bound_spacing(x, n), 2 * (n - i) - 1, wp.int32(0)
        farthest = bound_norm(motion)
        while j < most:
            N = compute_shapes(i, j, n)
            room = compute_core_distance(N * x, sizes, radius).distance + radius
            far = wp.length(N * motion)
            if far > kept * room:
                out = wp.min(out, kept * room / far)
            j += compute_offset(room - farthest / kept, pace, most)
        return out

    return ToolFunctions(
        forces=forces, get_motion=get_motion, get_positions=get_positions, to_core_axes=to_core_axes,
        add_forces=add_forces, get_stiffness=get_stiffness, bound_norm=bound_norm, bound_spacing=bound_spacing,
        bound_distance=bound_distance, is_near=is_near, compute_shapes=compute_shapes, sum_row_energy=sum_row_energy,
        sum_row_forces=sum_row_forces, add_row_matrix=add_row_matrix, bound_row_step=bound_row_step,
    )  # fmt: skip
