"""What contact is at a surface triangle and a tool: its forces, its curvature, and how far it lets the triangle go."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from ...runtime.device import Device
from .barrier import barrier, barrier_curvature, barrier_slope

# A step takes no point farther than this share of its distance from the middle of a tool.
ROOM_KEPT = 0.8
# Curved triangles reach farther from their centre than their nodes do.
BULGE = 1.5
# From one point of a row to the next it is so many times what the nodes are from the middle of their corners, over the
# pieces: the shape functions' slopes, summed.
STEEP = {3: 4.0 / 3.0, 6: 28.0 / 3.0}


@wp.struct
class Tools:
    """T tools in b columns: cores as `tools.Core`, and how they stand: rotations and places."""

    centre: wp.array(dtype=wp.vec3d)
    half: wp.array(dtype=wp.vec3d)
    radius: wp.array(dtype=wp.float64)
    rotation: wp.array2d(dtype=wp.mat33d)
    origin: wp.array2d(dtype=wp.vec3d)


@wp.struct
class Surface:
    """Surface triangles: their nodes' places at rest and numbers, areas, and into how many parts an edge is cut."""

    rest: wp.array(dtype=wp.vec3d)
    table: wp.array2d(dtype=wp.int32)
    pieces: wp.array(dtype=wp.int32)
    area: wp.array(dtype=wp.float64)


@wp.struct
class Scale:
    """How wide the barrier is [m], and how stiff [Pa/m]."""

    gap: wp.float64
    stiffness: wp.float64


@wp.struct
class ToolDistance:
    """Distance to a tool [m], its gradient, and its second derivative [1/m]."""

    distance: wp.float64
    normal: wp.vec3d
    bend: wp.mat33d


@wp.func
def touch_of(p: wp.vec3d, half: wp.vec3d, radius: wp.float64) -> ToolDistance:
    """As a core sees a point: d = |v| - r, v from its nearest point to p; n = v / |v|; dn = (M - n (x) n) / |v|.

    M keeps the components in which p lies beyond the core.
    """
    one, zero = wp.float64(1.0), wp.float64(0.0)
    v, beyond = wp.vec3d(), wp.vec3d()
    for i in range(3):
        v[i] = p[i] - wp.clamp(p[i], -half[i], half[i])
        beyond[i] = wp.where(v[i] != zero or half[i] == zero, one, zero)
    length = wp.length(v)
    out = ToolDistance()
    out.distance = length - radius
    out.normal = wp.vec3d(zero, zero, -one)  # on the core itself: away from the shaft
    if length > zero:
        out.normal = v / length
        out.bend = (wp.diag(beyond) - wp.outer(out.normal, out.normal)) / length
    return out


@wp.func
def clear(room: wp.float64, pace: wp.float64, most: int) -> int:
    """How many points on, 1 to `most`, the next is that may lack room: from one to the next it shrinks by a pace."""
    out = wp.int32(1)
    if room > pace:
        out = wp.int32(wp.min(room / pace, wp.float64(most)))
    return out


@wp.func
def curvature_at(touch: ToolDistance, gap: wp.float64, definite: int) -> wp.mat33d:
    """b'' n (x) n + b' dn; the first alone, which is never negative, where `definite`."""
    out = barrier_curvature(touch.distance, gap) * wp.outer(touch.normal, touch.normal)
    if definite == 0:
        out += barrier_slope(touch.distance, gap) * touch.bend
    return out


@dataclass(frozen=True)
class ToolFunctions:
    """Functions of Warp for triangles of one number of nodes, of which `forces` (size, 3) are a type.

    A triangle is looked at in the centres of pieces^2 equal parts, which lie in as many rows as there are pieces. What
    says `_in_row` is the sum over one of these rows. It is asked and answered in the axes of a core (`seen`), and looks
    at no point that is surely out of its reach.
    """

    forces: Any
    motion_of: wp.Function
    nodes_of: wp.Function
    seen: wp.Function
    spread: wp.Function
    weight_of: wp.Function
    reach_of: wp.Function
    pace_of: wp.Function
    least_distance: wp.Function
    is_near: wp.Function
    shape_of: wp.Function
    energy_in_row: wp.Function
    force_in_row: wp.Function
    add_matrix_in_row: wp.Function
    share_in_row: wp.Function


@cache
def build_functions(device: Device, size: int) -> ToolFunctions:
    """Functions for surface triangles of `size` nodes, 3 or 6.

    Positions and distances are in double precision whatever the device's scalar: gaps are small beside bodies.
    """
    scalar = device.scalar
    shares = wp.types.vector(length=size, dtype=wp.float64)
    forces = wp.types.matrix(shape=(size, 3), dtype=wp.float64)
    blocks = wp.types.matrix(shape=(3 * size * (size + 1) // 2, 3), dtype=wp.float64)
    bulge, kept = wp.constant(wp.float64(BULGE if size == 6 else 1.0)), wp.constant(wp.float64(ROOM_KEPT))
    steep = wp.constant(wp.float64(STEEP[size]))

    @wp.func
    def shape_of(i: int, j: int, n: int) -> shares:
        """Shape functions at the centre of the j-th part of the i-th row; odd parts are turned round."""
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
    def motion_of(surface: Surface, u: wp.array2d(dtype=scalar), s: int, c: int) -> forces:
        """How far a triangle's nodes go (size, 3)."""
        out = forces()
        for a in range(size):
            for k in range(3):
                out[a, k] = wp.float64(u[3 * surface.table[s, a] + k, c])
        return out

    @wp.func
    def nodes_of(surface: Surface, u: wp.array2d(dtype=scalar), s: int, c: int) -> forces:
        """Where they are (size, 3)."""
        out = motion_of(surface, u, s, c)
        for a in range(size):
            for k in range(3):
                out[a, k] += surface.rest[surface.table[s, a]][k]
        return out

    @wp.func
    def seen(at: forces, tools: Tools, k: int, c: int) -> forces:
        """Return the same from the middle of a core, along its axes."""
        R = tools.rotation[k, c]
        start = tools.origin[k, c] + R * tools.centre[k]
        out = forces()
        for a in range(size):
            out[a] = wp.transpose(R) * (at[a] - start)
        return out

    @wp.func
    def spread(surface: Surface, total: forces, s: int, c: int, out: wp.array2d(dtype=scalar)):
        """f_a += total_a."""
        for a in range(size):
            for k in range(3):
                wp.atomic_add(out, 3 * surface.table[s, a] + k, c, scalar(total[a, k]))

    @wp.func
    def weight_of(surface: Surface, scale: Scale, s: int) -> wp.float64:
        """Stiffness times the area that each point of a triangle stands for [N/m]."""
        return scale.stiffness * surface.area[s] / wp.float64(surface.pieces[s] * surface.pieces[s])

    @wp.func
    def reach_of(along: forces) -> wp.float64:
        """How far a point of a triangle is from where there is nothing, at most: (size, 3) from there."""
        out = wp.float64(0.0)
        for a in range(size):
            out = wp.max(out, wp.length(along[a]))
        return bulge * out

    @wp.func
    def around(at: forces) -> forces:
        """Nodes (size, 3) from the middle of their corners."""
        middle, out = wp.vec3d(), at
        for a in range(3):
            middle += at[a] / wp.float64(3.0)
        for a in range(size):
            out[a] = at[a] - middle
        return out

    @wp.func
    def pace_of(at: forces, n: int) -> wp.float64:
        """How far one point of a row is from the next, at most.

        Between them barycentric coordinates change by 1, 1 and 2 thirds of a piece.
        """
        return steep * reach_of(around(at)) / (bulge * wp.float64(n))

    @wp.func
    def least_distance(at: forces, times: wp.float64, half: wp.vec3d, radius: wp.float64) -> wp.float64:
        """No point of a triangle so many times as large is nearer to a core."""
        arms = around(at)
        return touch_of(at[0] - arms[0], half, radius).distance - times * reach_of(arms)

    @wp.func
    def is_near(at: forces, reach: wp.float64, half: wp.vec3d, radius: wp.float64) -> bool:
        """Whether any point of a triangle may be in a core's reach."""
        return least_distance(at, wp.float64(1.0), half, radius) < reach

    @wp.func
    def energy_in_row(at: forces, n: int, i: int, half: wp.vec3d, radius: wp.float64, gap: wp.float64) -> wp.float64:
        """Sum over points of b(d)."""
        total, pace, most, j = wp.float64(0.0), pace_of(at, n), 2 * (n - i) - 1, wp.int32(0)
        while j < most:
            d = touch_of(shape_of(i, j, n) * at, half, radius).distance
            total += barrier(d, gap)
            j += clear(d - gap, pace, most)
        return total

    @wp.func
    def force_in_row(at: forces, n: int, i: int, half: wp.vec3d, radius: wp.float64, gap: wp.float64) -> forces:
        """Sum over points of N_a b'(d) n."""
        total, pace, most, j = forces(), pace_of(at, n), 2 * (n - i) - 1, wp.int32(0)
        while j < most:
            N = shape_of(i, j, n)
            touch = touch_of(N * at, half, radius)
            if touch.distance < gap:
                total += wp.outer(N, barrier_slope(touch.distance, gap) * touch.normal)
            j += clear(touch.distance - gap, pace, most)
        return total

    @wp.func
    def add_matrix_in_row(
        at: forces,
        surface: Surface,
        tools: Tools,
        scale: Scale,
        definite: int,
        place: wp.array2d(dtype=wp.int32),
        s: int,
        i: int,
        k: int,
        c: int,
        out: wp.array3d(dtype=wp.float64),
    ):
        """K_ab += sum over points of w k H N_a N_b between the nodes that have a place."""
        n, half, radius = surface.pieces[s], tools.half[k], tools.radius[k]
        total, felt, pace, most, j = blocks(), wp.bool(False), pace_of(at, n), 2 * (n - i) - 1, wp.int32(0)
        while j < most:
            N = shape_of(i, j, n)
            touch = touch_of(N * at, half, radius)
            if touch.distance < scale.gap:
                felt = True
                H = curvature_at(touch, scale.gap, definite)
                for a in range(size):
                    for b in range(size):
                        if b <= a:
                            for row in range(3):
                                q = 3 * (a * (a + 1) // 2 + b) + row
                                total[q] = total[q] + N[a] * N[b] * H[row]
            j += clear(touch.distance - scale.gap, pace, most)
        if felt:
            R, weight = tools.rotation[k, c], weight_of(surface, scale, s)
            for a in range(size):
                first = 3 * place[surface.table[s, a], c]
                for b in range(size):
                    second, q = 3 * place[surface.table[s, b], c], 3 * (a * (a + 1) // 2 + b)
                    if b <= a and first >= 0 and second >= 0:
                        H = weight * (R * wp.matrix_from_rows(total[q], total[q + 1], total[q + 2]) * wp.transpose(R))
                        for row in range(3):
                            for column in range(3):
                                wp.atomic_add(out, c, first + row, second + column, H[row, column])
                                if a != b:
                                    wp.atomic_add(out, c, second + column, first + row, H[row, column])

    @wp.func
    def share_in_row(at: forces, along: forces, n: int, i: int, half: wp.vec3d, radius: wp.float64) -> wp.float64:
        """Return the share of a motion, at most 1, after which no point is as far as the middle of a core."""
        out, pace, most, j = wp.float64(1.0), pace_of(at, n), 2 * (n - i) - 1, wp.int32(0)
        farthest = reach_of(along)
        while j < most:
            N = shape_of(i, j, n)
            room = touch_of(N * at, half, radius).distance + radius
            far = wp.length(N * along)
            if far > kept * room:
                out = wp.min(out, kept * room / far)
            j += clear(room - farthest / kept, pace, most)
        return out

    return ToolFunctions(
        forces=forces,
        motion_of=motion_of,
        nodes_of=nodes_of,
        seen=seen,
        spread=spread,
        weight_of=weight_of,
        reach_of=reach_of,
        pace_of=pace_of,
        least_distance=least_distance,
        is_near=is_near,
        shape_of=shape_of,
        energy_in_row=energy_in_row,
        force_in_row=force_in_row,
        add_matrix_in_row=add_matrix_in_row,
        share_in_row=share_in_row,
    )
