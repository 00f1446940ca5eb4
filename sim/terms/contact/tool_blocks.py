"""Tool contact with one thread block per load case: forces, tangent stiffness and step bounds."""

from functools import cache

import warp as wp

from ...discretisation.term import BlockFunctions
from ...runtime.blocks import get_block_shape, get_max, wait
from ...runtime.device import Device
from .tool_functions import BULGE_BOUND, MAX_STEP_FRACTION, BarrierScale, Surface, Tools
from .tool_functions import build_functions as at_triangles


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
    threads, one = down * across, at_triangles(device, size)

    bulge, kept = wp.constant(wp.float64(BULGE_BOUND)), wp.constant(wp.float64(MAX_STEP_FRACTION))
    nodes_of, motion_of, seen, spread = one.nodes_of, one.motion_of, one.seen, one.spread
    weight_of, reach_of, is_near, force_in_row = one.weight_of, one.reach_of, one.is_near, one.force_in_row
    add_matrix_in_row, share_in_row = one.add_matrix_in_row, one.share_in_row

    @wp.func
    def look(
        x: wp.array2d(dtype=wp.float64), reach: wp.float64, stage: ContactStruct, near: NearPairs, c: int, me: int
    ) -> int:
        """Find the pairs within the distance `reach`; return the maximum number of their sample rows."""
        if me == 0:
            near.count[c] = 0
        wait()
        tools = stage.tools.radius.shape[0]
        for pair in range(me, stage.surface.area.shape[0] * tools, threads):
            k = pair % tools
            own = seen(nodes_of(stage.surface, x, pair // tools, c), stage.tools, k, c)
            if is_near(own, reach, stage.tools.half[k], stage.tools.radius[k]):
                near.pairs[c, wp.atomic_add(near.count, c, 1)] = pair
        wait()
        return stage.rows * near.count[c]

    @wp.func
    def add_force(
        x: wp.array2d(dtype=wp.float64),
        stage: ContactStruct,
        near: NearPairs,
        c: int,
        me: int,
        # outputs
        out: wp.array2d(dtype=wp.float64),
    ):
        """Add forces f_a += sum over points of w k b'(d) n N_a, and store the near pairs at x."""
        tools, gap = stage.tools.radius.shape[0], stage.scale.gap
        for item in range(me, look(x, gap, stage, near, c, me), threads):
            pair, i = near.pairs[c, item // stage.rows], item % stage.rows
            s, k = pair // tools, pair % tools
            n = stage.surface.pieces[s]
            if i < n:
                own = seen(nodes_of(stage.surface, x, s, c), stage.tools, k, c)
                force = force_in_row(own, n, i, stage.tools.half[k], stage.tools.radius[k], gap)
                if reach_of(force) > wp.float64(0.0):
                    weight = weight_of(stage.surface, stage.scale, s)
                    spread(stage.surface, weight * force * wp.transpose(stage.tools.rotation[k, c]), s, c, out)
        wait()

    @wp.func
    def add_matrix(
        x: wp.array2d(dtype=wp.float64),
        stage: ContactStruct,
        near: NearPairs,
        definite: int,
        place: wp.array2d(dtype=wp.int32),
        c: int,
        me: int,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Add K_ab += sum over points of w k H N_a N_b between nodes with `place` >= 0, for the stored near pairs."""
        tools = stage.tools.radius.shape[0]
        for item in range(me, stage.rows * near.count[c], threads):
            pair, i = near.pairs[c, item // stage.rows], item % stage.rows
            s, k = pair // tools, pair % tools
            if i < stage.surface.pieces[s]:
                own = seen(nodes_of(stage.surface, x, s, c), stage.tools, k, c)
                add_matrix_in_row(own, stage.surface, stage.tools, stage.scale, definite, place, s, i, k, c, out)
        wait()

    @wp.func
    def longest(
        x: wp.array2d(dtype=wp.float64),
        way: wp.array2d(dtype=wp.float64),
        stage: ContactStruct,
        near: NearPairs,
        c: int,
        me: int,
    ) -> wp.float64:
        """Return the allowed fraction, at most 1, of the step `way` from x; overwrite the near pairs."""
        far = wp.float64(0.0)
        for i in range(me, x.shape[0] // 3, threads):
            far = wp.max(far, wp.length(wp.vec3d(way[3 * i, c], way[3 * i + 1, c], way[3 * i + 2, c])))
        farthest = get_max(far)
        if me == 0:
            near.least[c] = wp.float64(1.0)
        tools = stage.tools.radius.shape[0]
        for item in range(me, look(x, bulge * farthest / kept, stage, near, c, me), threads):
            pair, i = near.pairs[c, item // stage.rows], item % stage.rows
            s, k = pair // tools, pair % tools
            n = stage.surface.pieces[s]
            if i < n:
                own, along = (
                    seen(nodes_of(stage.surface, x, s, c), stage.tools, k, c),
                    motion_of(stage.surface, way, s, c),
                )
                wp.atomic_min(near.least, c, share_in_row(own, along, n, i, stage.tools.half[k], stage.tools.radius[k]))
        wait()
        return near.least[c]

    return BlockFunctions(ContactStruct, NearPairs, add_force, add_matrix, longest)
