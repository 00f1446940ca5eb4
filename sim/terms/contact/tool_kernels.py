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
    compute_core_distance,
    compute_curvature,
    compute_offset,
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
    bound_clearance: wp.Kernel
    measure_depth: wp.Kernel


@cache
def build_kernels(device: Device, size: int) -> ToolKernels:
    """Return kernels over (triangle, load case), for surface triangles with `size` nodes, 3 or 6."""
    scalar, mat = device.scalar, device.matrix
    functions, kept = build_functions(device, size), wp.constant(wp.float64(MAX_STEP_FRACTION))
    stretch = wp.constant(wp.float64(1.0 if size == 6 else BULGE_BOUND))
    forces, get_positions, get_motion = functions.forces, functions.get_positions, functions.get_motion
    to_core_axes, add_forces, get_stiffness = functions.to_core_axes, functions.add_forces, functions.get_stiffness
    is_near, bound_distance, bound_norm = functions.is_near, functions.bound_distance, functions.bound_norm
    bound_spacing, compute_shapes = functions.bound_spacing, functions.compute_shapes
    sum_row_energy, sum_row_forces = functions.sum_row_energy, functions.sum_row_forces
    add_row_matrix, bound_row_step = functions.add_row_matrix, functions.bound_row_step

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
        at, n, weight = get_positions(surface, u, s, c), surface.pieces[s], get_stiffness(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                total = wp.float64(0.0)
                for i in range(n):
                    total += sum_row_energy(own, n, i, half, radius, scale.gap)
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
        at, n, weight = get_positions(surface, u, s, c), surface.pieces[s], get_stiffness(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                total = forces()
                for i in range(n):
                    total += sum_row_forces(own, n, i, half, radius, scale.gap)
                add_forces(surface, weight * total * wp.transpose(tools.rotation[k, c]), s, c, out)

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
        at, n, weight = get_positions(surface, u, s, c), surface.pieces[s], get_stiffness(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                motion, total = get_motion(surface, p, s, c) * tools.rotation[k, c], forces()
                pace = bound_spacing(own, n)
                for i in range(n):
                    most, j = 2 * (n - i) - 1, wp.int32(0)
                    while j < most:
                        N = compute_shapes(i, j, n)
                        contact = compute_core_distance(N * own, half, radius)
                        if contact.distance < scale.gap:
                            total += wp.outer(N, compute_curvature(contact, scale.gap, definite[c]) * (N * motion))
                        j += compute_offset(contact.distance - scale.gap, pace, most)
                add_forces(surface, weight * total * wp.transpose(tools.rotation[k, c]), s, c, out)

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
        at, n, weight = get_positions(surface, u, s, c), surface.pieces[s], get_stiffness(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius, R = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k], tools.rotation[k, c]
            if is_near(own, scale.gap, half, radius):
                pace = bound_spacing(own, n)
                for i in range(n):
                    most, j = 2 * (n - i) - 1, wp.int32(0)
                    while j < most:
                        N = compute_shapes(i, j, n)
                        contact = compute_core_distance(N * own, half, radius)
                        if contact.distance < scale.gap:
                            H = weight * (R * compute_curvature(contact, scale.gap, definite[c]) * wp.transpose(R))
                            for a in range(size):
                                block = mat()
                                for row in range(3):
                                    for column in range(3):
                                        block[row, column] = scalar(N[a] * N[a] * H[row, column])
                                wp.atomic_add(out, surface.table[s, a], c, block)
                        j += compute_offset(contact.distance - scale.gap, pace, most)

    @forward_kernel(module="unique")
    def add_matrix(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        index: wp.array2d(dtype=wp.int32),
        surface: Surface,
        tools: Tools,
        scale: BarrierScale,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add the tangent stiffness: K_ab += sum over points of w k H N_a N_b, between the nodes with `index` >= 0."""
        s, c = wp.tid()
        at = get_positions(surface, u, s, c)
        for k in range(tools.radius.shape[0]):
            own = to_core_axes(at, tools, k, c)
            if is_near(own, scale.gap, tools.half[k], tools.radius[k]):
                for i in range(surface.pieces[s]):
                    add_row_matrix(own, surface, tools, scale, definite[c], index, s, i, k, c, out)

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
        at, n, weight = get_positions(surface, u, s, c), surface.pieces[s], get_stiffness(surface, scale, s)
        for k in range(tools.radius.shape[0]):
            own, half, radius = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, scale.gap, half, radius):
                force, moment, pace = wp.vec3d(), wp.vec3d(), bound_spacing(own, n)
                for i in range(n):
                    most, j = 2 * (n - i) - 1, wp.int32(0)
                    while j < most:
                        x = compute_shapes(i, j, n) * own
                        contact = compute_core_distance(x, half, radius)
                        push = -weight * barrier_slope(contact.distance, scale.gap) * contact.normal
                        force += push
                        moment += wp.cross(x + tools.centre[k], push)
                        j += compute_offset(contact.distance - scale.gap, pace, most)
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
        """Limit the step to a fraction of (distance + radius) / |dx|: no point reaches a tool's centre or passes it."""
        s, c = wp.tid()
        at, n, along = get_positions(surface, u, s, c), surface.pieces[s], get_motion(surface, du, s, c)
        for k in range(tools.radius.shape[0]):
            own, half, radius = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, bound_norm(along) / kept, half, radius):
                for i in range(n):
                    wp.atomic_min(out, c, scalar(bound_row_step(own, along, n, i, half, radius)))

    @forward_kernel(module="unique")
    def bound_clearance(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Compute a lower bound of the distance of each tool from the surface, which may be curved or stretched."""
        s, c = wp.tid()
        at = get_positions(surface, u, s, c)
        for k in range(tools.radius.shape[0]):
            own, half, radius = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k]
            wp.atomic_min(out, k, c, bound_distance(own, stretch, half, radius))

    @forward_kernel(module="unique")
    def measure_depth(
        u: wp.array2d(dtype=scalar),
        surface: Surface,
        tools: Tools,
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Compute the minimum signed distance from surface points to each core; 0 if no distance is negative."""
        s, c = wp.tid()
        at, n = get_positions(surface, u, s, c), surface.pieces[s]
        for k in range(tools.radius.shape[0]):
            own, half, radius = to_core_axes(at, tools, k, c), tools.half[k], tools.radius[k]
            if is_near(own, wp.float64(0.0), half, radius):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        x = compute_shapes(i, j, n) * own
                        wp.atomic_min(out, k, c, compute_core_distance(x, half, radius).distance)

    return ToolKernels(
        add_energy=add_energy, add_gradient=add_gradient, add_curvature=add_curvature, add_diagonal=add_diagonal,
        add_matrix=add_matrix, add_reaction=add_reaction, bound_step=bound_step, bound_clearance=bound_clearance,
        measure_depth=measure_depth,
    )  # fmt: skip
