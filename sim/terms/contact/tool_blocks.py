"""Tool contact with one thread block per load case: forces, tangent stiffness and step bounds."""

from functools import cache

import warp as wp

from ...discretisation.term import BlockFunctions
from ...runtime.blocks import get_block_shape, get_max, wait
from ...runtime.device import Device
from .tool_functions import BULGE_BOUND, MAX_STEP_FRACTION, BarrierScale, Surface, Tools
from .tool_functions import build_functions as build_tool_functions


@wp.struct
class ContactStruct:
    """Arguments of contact functions: surface, tools, barrier, and maximum number of sample rows per triangle."""

    surface: Surface
    tools: Tools
    scale: BarrierScale
    rows: wp.int32


@wp.struct
class NearPairs:
    """Workspace for near pairs of triangle and tool: pairs (b, S T), their number (b,), and a scalar (b,)."""

    pairs: wp.array2d(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    least: wp.array(dtype=wp.float64)


@cache
def build_functions(device: Device, size: int) -> BlockFunctions:
    """Return the functions for surface triangles with `size` nodes, 3 or 6."""
    down, across = get_block_shape(device)
    threads, functions = down * across, build_tool_functions(device, size)

    bulge, kept = wp.constant(wp.float64(BULGE_BOUND)), wp.constant(wp.float64(MAX_STEP_FRACTION))
    get_positions, get_motion, to_core_axes = functions.get_positions, functions.get_motion, functions.to_core_axes
    add_forces, get_stiffness, bound_norm = functions.add_forces, functions.get_stiffness, functions.bound_norm
    is_near, sum_row_forces = functions.is_near, functions.sum_row_forces
    add_row_matrix, bound_row_step = functions.add_row_matrix, functions.bound_row_step

    @wp.func
    def find_near_pairs(
        x: wp.array2d(dtype=wp.float64), gap: wp.float64, contact: ContactStruct, near: NearPairs, c: int, thread: int
    ) -> int:
        """Find the pairs within the distance `gap`; return the maximum number of their sample rows."""
        if thread == 0:
            near.count[c] = 0
        wait()
        tools = contact.tools.radius.shape[0]
        for pair in range(thread, contact.surface.area.shape[0] * tools, threads):
            k = pair % tools
            own = to_core_axes(get_positions(contact.surface, x, pair // tools, c), contact.tools, k, c)
            if is_near(own, gap, contact.tools.half[k], contact.tools.radius[k]):
                near.pairs[c, wp.atomic_add(near.count, c, 1)] = pair
        wait()
        return contact.rows * near.count[c]

    @wp.func
    def add_force(
        x: wp.array2d(dtype=wp.float64),
        contact: ContactStruct,
        near: NearPairs,
        c: int,
        thread: int,
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Add forces f_a += sum over points of w k b'(d) n N_a, and store the near pairs at x."""
        tools, gap = contact.tools.radius.shape[0], contact.scale.gap
        for item in range(thread, find_near_pairs(x, gap, contact, near, c, thread), threads):
            pair, i = near.pairs[c, item // contact.rows], item % contact.rows
            s, k = pair // tools, pair % tools
            n = contact.surface.pieces[s]
            if i < n:
                own = to_core_axes(get_positions(contact.surface, x, s, c), contact.tools, k, c)
                force = sum_row_forces(own, n, i, contact.tools.half[k], contact.tools.radius[k], gap)
                if bound_norm(force) > wp.float64(0.0):
                    weight = get_stiffness(contact.surface, contact.scale, s)
                    add_forces(contact.surface, weight * force * wp.transpose(contact.tools.rotation[k, c]), s, c, out)
        wait()

    @wp.func
    def add_matrix(
        x: wp.array2d(dtype=wp.float64),
        contact: ContactStruct,
        near: NearPairs,
        definite: int,
        index: wp.array2d(dtype=wp.int32),
        c: int,
        thread: int,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add K_ab += sum over points of w k H N_a N_b between nodes with `index` >= 0, for the stored near pairs."""
        tools = contact.tools.radius.shape[0]
        for item in range(thread, contact.rows * near.count[c], threads):
            pair, i = near.pairs[c, item // contact.rows], item % contact.rows
            s, k = pair // tools, pair % tools
            if i < contact.surface.pieces[s]:
                own = to_core_axes(get_positions(contact.surface, x, s, c), contact.tools, k, c)
                add_row_matrix(own, contact.surface, contact.tools, contact.scale, definite, index, s, i, k, c, out)
        wait()

    @wp.func
    def bound_step(
        x: wp.array2d(dtype=wp.float64),
        step: wp.array2d(dtype=wp.float64),
        contact: ContactStruct,
        near: NearPairs,
        c: int,
        thread: int,
    ) -> wp.float64:
        """Return the allowed fraction, at most 1, of the step `step` from x; overwrite the near pairs."""
        far = wp.float64(0.0)
        for i in range(thread, x.shape[0] // 3, threads):
            far = wp.max(far, wp.length(wp.vec3d(step[3 * i, c], step[3 * i + 1, c], step[3 * i + 2, c])))
        farthest = get_max(far)
        if thread == 0:
            near.least[c] = wp.float64(1.0)
        tools = contact.tools.radius.shape[0]
        for item in range(thread, find_near_pairs(x, bulge * farthest / kept, contact, near, c, thread), threads):
            pair, i = near.pairs[c, item // contact.rows], item % contact.rows
            s, k = pair // tools, pair % tools
            n = contact.surface.pieces[s]
            if i < n:
                own = to_core_axes(get_positions(contact.surface, x, s, c), contact.tools, k, c)
                motion, half = get_motion(contact.surface, step, s, c), contact.tools.half[k]
                wp.atomic_min(near.least, c, bound_row_step(own, motion, n, i, half, contact.tools.radius[k]))
        wait()
        return near.least[c]

    return BlockFunctions(ContactStruct, NearPairs, add_force, add_matrix, bound_step)
