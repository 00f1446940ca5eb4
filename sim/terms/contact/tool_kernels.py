"""Warp kernels of tool contact over surface triangles."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ...runtime.device import Device, forward_kernel
from .barrier import barrier_slope
from .tool_functions import (
    BULGE_BOUND,
    MAX_STEP_FRACTION,
    BarrierScale,
    Surface,
    Tools,
    build_functions,
    curvature_at,
    distance_to_core,
    skip,
)


@dataclass(frozen=True)
class ToolKernels:
    """Kernels over (triangle, load case), for triangles with a fixed number of nodes."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel
    add_matrix: wp.Kernel
    add_reaction: wp.Kernel
    bound_step: wp.Kernel
    clearance: wp.Kernel
    nearest: wp.Kernel


@cache
def build_kernels(device: Device, size: int) -> ToolKernels:
    """Return kernels over (triangle, load case), for surface triangles with `size` nodes, 3 or 6."""
    scalar, mat = device.scalar, device.matrix
    here, kept = build_functions(device, size), wp.constant(wp.float64(MAX_STEP_FRACTION))
    stretch = wp.constant(wp.float64(1.0 if size == 6 else BULGE_BOUND))
    forces, nodes_of, motion_of, seen, spread = here.forces, here.nodes_of, here.motion_of, here.seen, here.spread
    weight_of, is_near, least_distance, reach_of, pace_of, shape_of = (
        here.weight_of,
        here.is_near,
        here.least_distance,
        here.reach_of,
        here.pace_of,
        here.shape_of,
    )
    energy_in_row, force_in_row = here.energy_in_row, here.force_in_row
    add_matrix_in_row, share_in_row = here.add_matrix_in_row, here.share_in_row

    @forward_kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Add the energy: E += sum over points of w k b(d)."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = seen(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                total = wp.float64(0.0)
                for i in range(n):
                    total += energy_in_row(own, n, i, half, radius, scale.gap)
                wp.atomic_add(out, c, weight * total)

    @forward_kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add the gradient: g_a += sum over points of w k b'(d) n N_a."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = seen(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                total = forces()
                for i in range(n):
                    total += force_in_row(own, n, i, half, radius, scale.gap)
                spread(surface, weight * total * wp.transpose(tools.rotation[k, c]), s, c, out)

    @forward_kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add the tangent stiffness times p: f_a += sum over points of w k H N_a sum over nodes of N_b p_b."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = seen(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                along, total, pace = motion_of(surface, p, s, c) * tools.rotation[k, c], forces(), pace_of(own, n)
                for i in range(n):
                    most, j = 2 * (n - i) - 1, wp.int32(0)
                    while j < most:
                        N = shape_of(i, j, n)
                        touch = distance_to_core(N * own, half, radius)
                        if touch.distance < scale.gap:
                            total += wp.outer(N, curvature_at(touch, scale.gap, definite[c]) * (N * along))
                        j += skip(touch.distance - scale.gap, pace, most)
                spread(surface, weight * total * wp.transpose(tools.rotation[k, c]), s, c, out)

    @forward_kernel(module="unique")
    def add_diagonal(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """Add the diagonal blocks: K_aa += sum over points of w k H N_a^2."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius, R = seen(at, tools, k, c), tools.half[k], tools.radius[k], tools.rotation[k, c]
            if is_near(own, scale.gap, half, radius):
                pace = pace_of(own, n)
                for i in range(n):
                    most, j = 2 * (n - i) - 1, wp.int32(0)
                    while j < most:
                        N = shape_of(i, j, n)
                        touch = distance_to_core(N * own, half, radius)
                        if touch.distance < scale.gap:
                            H = weight * (R * curvature_at(touch, scale.gap, definite[c]) * wp.transpose(R))
                            for a in range(size):
                                block = mat()
                                for row in range(3):
                                    for column in range(3):
                                        block[row, column] = scalar(N[a] * N[a] * H[row, column])
                                wp.atomic_add(out, surface.table[s, a], c, block)
                        j += skip(touch.distance - scale.gap, pace, most)

    @forward_kernel(module="unique")
    def add_matrix(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        place: wp.array2d(dtype=wp.int32),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add the tangent stiffness: K_ab += sum over points of w k H N_a N_b, between the nodes with `place` >= 0."""
        s, c = wp.tid()
        at = nodes_of(surface, u, s, c)
        for k in range(tools.radius.shape[0]):
            own = seen(at, tools, k, c)
            if is_near(own, scale.gap, tools.half[k], tools.radius[k]):
                for i in range(surface.pieces[s]):
                    add_matrix_in_row(own, surface, tools, scale, definite[c], place, s, i, k, c, out)

    @forward_kernel(module="unique")
    def add_reaction(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add the force of each tool, the sum of -w k b'(d) n over points, and its moment about the tool's origin."""
        s, c = wp.tid()
        at, n, weight = nodes_of(surface, u, s, c), surface.pieces[s], weight_of(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = seen(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                force, moment, pace = wp.vec3d(), wp.vec3d(), pace_of(own, n)
                for i in range(n):
                    most, j = 2 * (n - i) - 1, wp.int32(0)
                    while j < most:
                        x = shape_of(i, j, n) * own
                        touch = distance_to_core(x, half, radius)
                        push = -weight * barrier_slope(touch.distance, scale.gap) * touch.normal
                        force += push
                        moment += wp.cross(x + tools.centre[k], push)
                        j += skip(touch.distance - scale.gap, pace, most)
                force, moment = tools.rotation[k, c] * force, tools.rotation[k, c] * moment
                for row in range(3):
                    wp.atomic_add(out, c, k, row, force[row])
                    wp.atomic_add(out, c, k, 3 + row, moment[row])

    @forward_kernel(module="unique")
    def bound_step(
        u: wp.array2d(dtype=scalar),
        du: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array(dtype=scalar),
    ):
        """Limit t to kept (d + r) / |dx|, so that no point moves to the centre of a tool or through the tool."""
        s, c = wp.tid()
        at, n, along = nodes_of(surface, u, s, c), surface.pieces[s], motion_of(surface, du, s, c)
        for k in range(tools.radius.shape[0]):
            own, half, radius = seen(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, reach_of(along) / kept, half, radius):
                for i in range(n):
                    wp.atomic_min(out, c, scalar(share_in_row(own, along, n, i, half, radius)))

    @forward_kernel(module="unique")
    def clearance(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Compute a lower bound of the distance of each tool from the surface, which may be curved or stretched."""
        s, c = wp.tid()
        at = nodes_of(surface, u, s, c)
        for k in range(tools.radius.shape[0]):
            wp.atomic_min(out, k, c, least_distance(seen(at, tools, k, c), stretch, tools.half[k], tools.radius[k]))

    @forward_kernel(module="unique")
    def nearest(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Compute the minimum signed distance from surface points to each core; 0 if no distance is negative."""
        s, c = wp.tid()
        at, n = nodes_of(surface, u, s, c), surface.pieces[s]
        for k in range(tools.radius.shape[0]):
            own, half, radius = seen(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, wp.float64(0.0), half, radius):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        wp.atomic_min(out, k, c, distance_to_core(shape_of(i, j, n) * own, half, radius).distance)

    return ToolKernels(
        add_energy=add_energy,
        add_gradient=add_gradient,
        add_curvature=add_curvature,
        add_diagonal=add_diagonal,
        add_matrix=add_matrix,
        add_reaction=add_reaction,
        bound_step=bound_step,
        clearance=clearance,
        nearest=nearest,
    )
