"""The loops of contact: over surface triangles and the points in which they are looked at."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ...runtime.device import Device, forward_kernel
from .barrier import barrier, barrier_curvature, barrier_slope

# A step takes no point farther than this share of its distance from the middle of a tool.
ROOM_KEPT = 0.8
# Curved triangles reach farther from their centre than their nodes do.
BULGE = 1.5


@dataclass(frozen=True)
class Kernels:
    """Loops over (triangle, column) for triangles of one number of nodes."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel
    add_matrix: wp.Kernel
    add_reaction: wp.Kernel
    bound_step: wp.Kernel


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
class Touch:
    """Distance to a tool [m], its gradient, and its second derivative [1/m]."""

    distance: wp.float64
    normal: wp.vec3d
    bend: wp.mat33d


@wp.func
def touch_of(x: wp.vec3d, tools: Tools, k: int, c: int) -> Touch:
    """d = |v| - r, v from the nearest point of the core to x; n = v / |v|; dn = (M - n (x) n) / |v|.

    M keeps the components in which x lies beyond the core.
    """
    one, zero = wp.float64(1.0), wp.float64(0.0)
    R, half = tools.rotation[k, c], tools.half[k]
    p = wp.transpose(R) * (x - tools.origin[k, c]) - tools.centre[k]
    v, beyond = wp.vec3d(), wp.vec3d()
    for i in range(3):
        v[i] = p[i] - wp.clamp(p[i], -half[i], half[i])
        beyond[i] = wp.where(v[i] != zero or half[i] == zero, one, zero)
    length = wp.length(v)
    out = Touch()
    out.distance = length - tools.radius[k]
    out.normal = R * wp.vec3d(zero, zero, -one)  # on the core itself: away from the shaft
    if length > zero:
        n = v / length
        out.normal = R * n
        out.bend = R * ((wp.diag(beyond) - wp.outer(n, n)) / length) * wp.transpose(R)
    return out


@cache
def kernels_of(device: Device, size: int) -> Kernels:
    """Kernels for surface triangles of `size` nodes, 3 or 6.

    Positions and distances are in double precision whatever the device's scalar: gaps are small beside bodies. Each
    launches over (triangle, column); a triangle near a tool is looked at in the centres of pieces^2 equal parts.
    """
    scalar, mat = device.scalar, device.matrix
    shares = wp.types.vector(length=size, dtype=wp.float64)
    forces = wp.types.matrix(shape=(size, 3), dtype=wp.float64)
    bulge, kept = wp.constant(wp.float64(BULGE if size == 6 else 1.0)), wp.constant(wp.float64(ROOM_KEPT))

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
    def is_near(at: forces, tools: Tools, gap: wp.float64, k: int, c: int) -> bool:
        """Whether any point of a triangle may be in a tool's reach."""
        middle = wp.vec3d()
        for a in range(3):
            middle += at[a] / wp.float64(3.0)
        reach = wp.float64(0.0)
        for a in range(size):
            reach = wp.max(reach, wp.length(at[a] - middle))
        return touch_of(middle, tools, k, c).distance < gap + bulge * reach

    @forward_kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: Scale,
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """E += sum over points of w k b(d)."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, scale.gap, k, c):
                total = wp.float64(0.0)
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        total += barrier(touch_of(N * at, tools, k, c).distance, scale.gap)
                wp.atomic_add(out, c, weight * total)

    @forward_kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: Scale,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """g_a += sum over points of w k b'(d) n N_a."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, scale.gap, k, c):
                total = forces()
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        touch = touch_of(N * at, tools, k, c)
                        if touch.distance < scale.gap:
                            total += wp.outer(N, weight * barrier_slope(touch.distance, scale.gap) * touch.normal)
                spread(surface, total, s, c, out)

    @wp.func
    def curvature_at(touch: Touch, gap: wp.float64, definite: int) -> wp.mat33d:
        """b'' n (x) n + b' dn; the first alone, which is never negative, where `definite`."""
        out = barrier_curvature(touch.distance, gap) * wp.outer(touch.normal, touch.normal)
        if definite == 0:
            out += barrier_slope(touch.distance, gap) * touch.bend
        return out

    @forward_kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        surface: Surface,
        tools: Tools,
        scale: Scale,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """f_a += sum over points of w k H N_a sum over nodes of N_b p_b."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, scale.gap, k, c):
                along, total = motion_of(surface, p, s, c), forces()
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        touch = touch_of(N * at, tools, k, c)
                        if touch.distance < scale.gap:
                            total += wp.outer(N, weight * (curvature_at(touch, scale.gap, definite[c]) * (N * along)))
                spread(surface, total, s, c, out)

    @forward_kernel(module="unique")
    def add_diagonal(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        surface: Surface,
        tools: Tools,
        scale: Scale,
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """K_aa += sum over points of w k H N_a^2."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, scale.gap, k, c):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        touch = touch_of(N * at, tools, k, c)
                        if touch.distance < scale.gap:
                            H = weight * curvature_at(touch, scale.gap, definite[c])
                            for a in range(size):
                                block = mat()
                                for row in range(3):
                                    for column in range(3):
                                        block[row, column] = scalar(N[a] * N[a] * H[row, column])
                                wp.atomic_add(out, surface.table[s, a], c, block)

    @forward_kernel(module="unique")
    def add_matrix(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        place: wp.array2d(dtype=wp.int32),
        surface: Surface,
        tools: Tools,
        scale: Scale,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """K_ab += sum over points of w k H N_a N_b, of each column, between the nodes that have a place in it."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, scale.gap, k, c):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        touch = touch_of(N * at, tools, k, c)
                        if touch.distance < scale.gap:
                            H = weight * curvature_at(touch, scale.gap, definite[c])
                            for a in range(size):
                                first = 3 * place[surface.table[s, a], c]
                                for b in range(size):
                                    second = 3 * place[surface.table[s, b], c]
                                    if first >= 0 and second >= 0:
                                        for row in range(3):
                                            for column in range(3):
                                                share = N[a] * N[b] * H[row, column]
                                                wp.atomic_add(out, c, first + row, second + column, share)

    @forward_kernel(module="unique")
    def add_reaction(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: Scale,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Force and moment about each tool's origin, as the tool exerts them: sums of -w k b'(d) n and its moments."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, scale.gap, k, c):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        x = shape_of(i, j, n) * at
                        touch = touch_of(x, tools, k, c)
                        force = -weight * barrier_slope(touch.distance, scale.gap) * touch.normal
                        moment = wp.cross(x - tools.origin[k, c], force)
                        for row in range(3):
                            wp.atomic_add(out, c, k, row, force[row])
                            wp.atomic_add(out, c, k, 3 + row, moment[row])

    @forward_kernel(module="unique")
    def bound_step(
        u: wp.array2d(dtype=scalar),
        du: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: Scale,
        # outputs
        out: wp.array(dtype=scalar),
    ):
        """t <= kept (d + r) / |dx|: no point goes as far as the middle of a tool, and out at its other side."""
        s, c = wp.tid()
        at, n, along = nodes_of(surface, u, s, c), surface.pieces[s], motion_of(surface, du, s, c)
        farthest = wp.float64(0.0)
        for a in range(size):
            farthest = wp.max(farthest, wp.length(along[a]))
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, bulge * farthest / kept, k, c):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        room = kept * (touch_of(N * at, tools, k, c).distance + tools.radius[k])
                        far = wp.length(N * along)
                        if far > room:
                            wp.atomic_min(out, c, scalar(room / far))

    return Kernels(add_energy, add_gradient, add_curvature, add_diagonal, add_matrix, add_reaction, bound_step)
