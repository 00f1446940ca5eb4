"""Kernel of Newton's method for contact forces: one thread block solves one load case completely."""

from functools import cache

import warp as wp

from ..discretisation.term import BlockFunctions
from ..linalg.block_factor import build_functions
from ..minimisers.lbfgs_kernels import DEFAULT_BACKTRACK, MAX_BACKTRACK, MIN_BACKTRACK, OVERSHOOT
from ..runtime.blocks import get_block_shape, get_prefix, get_sum, wait
from ..runtime.device import Device, forward_kernel
from .contact_structs import NO_EQUILIBRIUM, OPEN, SOLVED, TOO_MANY_TOUCHED, UNKNOWN, ComplianceModel, Limits, Scratch

CPU_SUMS = 8  # Sums per thread at once, to hide memory latency on the CPU.
CUDA_SUMS = 2  # The same on CUDA, with its many threads.
TOUCHED, ACTING = wp.constant(0), wp.constant(1)  # Columns of `Scratch.counts`: touched nodes; nodes with a change.


@cache
def build_kernel(device: Device, barrier: BlockFunctions) -> wp.Kernel:
    """Return the kernel for a barrier, launched over (load case, thread)."""
    down, across = get_block_shape(device)
    threads, dense, Contact, Near = down * across, build_functions(device), barrier.barrier_struct, barrier.pairs_struct
    wide = wp.constant(CUDA_SUMS if device.on_cuda else CPU_SUMS)
    Strip = wp.types.vector(length=wide, dtype=wp.float64)
    overshoot, least, middle, most = (
        wp.constant(wp.float64(x)) for x in (OVERSHOOT, MIN_BACKTRACK, DEFAULT_BACKTRACK, MAX_BACKTRACK)
    )
    factor, solve, add_row = dense.factor, dense.solve, dense.add_row
    add_force, add_matrix, bound_step = barrier.add_force, barrier.add_matrix, barrier.bound_step

    @wp.func
    def dot(x: wp.array2d(dtype=wp.float64), y: wp.array2d(dtype=wp.float64), c: int, me: int) -> wp.float64:
        """Return the inner product x . y of a load case, computed by all threads of the block."""
        own = wp.float64(0.0)
        for r in range(me, x.shape[0], threads):
            own += x[r, c] * y[r, c]
        return get_sum(own)

    @wp.func
    def is_nonzero(x: wp.array2d(dtype=wp.float64), i: int, c: int) -> bool:
        """Return True if x is not zero at node i."""
        zero = wp.float64(0.0)
        return x[3 * i, c] != zero or x[3 * i + 1, c] != zero or x[3 * i + 2, c] != zero

    @wp.func
    def has_same_nodes(x: wp.array2d(dtype=wp.float64), index: wp.array2d(dtype=wp.int32), c: int, me: int) -> bool:
        """Return True if x is nonzero at exactly those nodes whose index in `index` is not -1."""
        other = wp.float64(0.0)
        for i in range(me, index.shape[0], threads):
            if is_nonzero(x, i, c) != (index[i, c] >= 0):
                other += wp.float64(1.0)
        return get_sum(other) == wp.float64(0.0)

    @wp.func
    def list_nodes(
        x: wp.array2d(dtype=wp.float64),
        index: wp.array2d(dtype=wp.int32),
        nodes: wp.array2d(dtype=wp.int32),
        counts: wp.array2d(dtype=wp.int32),
        column: int,
        c: int,
        me: int,
    ) -> int:
        """List the nodes with nonzero x in ascending order, set `index` (-1 for others), and return their number."""
        n = index.shape[0]
        own = (n + threads - 1) // threads
        begin, end = wp.min(me * own, n), wp.min((me + 1) * own, n)
        mine = wp.int32(0)
        for i in range(begin, end):
            if is_nonzero(x, i, c):
                mine += 1
        number = get_prefix(mine)
        for i in range(begin, end):
            index[i, c] = -1
            if is_nonzero(x, i, c):
                nodes[c, number] = i
                index[i, c] = number
                number += 1
        if me == threads - 1:
            counts[c, column] = number
        wait()
        return counts[c, column]

    @wp.func
    def compute_gradient(
        x: wp.array2d(dtype=wp.float64),
        positions: wp.array2d(dtype=wp.float64),
        contact: Contact,
        near: Near,
        s: Scratch,
        c: int,
        me: int,
    ):
        """Compute the gradient of the barrier and of the proximal term at x."""
        for r in range(me, x.shape[0], threads):
            s.slope[r, c] = s.held[r, c] * (x[r, c] - positions[r, c])
        add_force(x, contact, near, c, me, s.slope)

    @wp.func
    def assemble_curvature(contact: Contact, near: Near, definite: int, m: int, s: Scratch, c: int, me: int):
        """Assemble the curvature matrix of the barrier and of the proximal term at w, for the m touched nodes."""
        for i in range(me // across, 3 * m, down):
            for j in range(me % across, 3 * m, across):
                s.stiff[c, i, j] = wp.float64(0.0)
        wait()
        add_matrix(s.w, contact, near, definite, s.place, c, me, s.stiff)
        for i in range(me, 3 * m, threads):
            s.stiff[c, i, i] = s.stiff[c, i, i] + s.held[3 * s.touched[c, i // 3] + i % 3, c]
        wait()

    @wp.func
    def get_compliance_change(model: ComplianceModel, c: int, i: int, j: int) -> wp.float64:
        """Return an entry of the change of the compliance by strained tissue."""
        own = wp.float64(0.0)
        if model.own.shape[1] > 0:
            own = wp.float64(model.own[c, i, j])
        return own

    @wp.func
    def get_compliance(model: ComplianceModel, c: int, i: int, j: int) -> wp.float64:
        """Return a compliance entry of touched nodes, symmetrised, since half precision may round the columns."""
        return wp.float64(0.5) * (model.rest[i, j] + model.rest[j, i]) + get_compliance_change(model, c, i, j)

    @wp.func
    def list_changes(model: ComplianceModel, s: Scratch, c: int, me: int) -> int:
        """List the nodes on which the force change acts, compute its L-BFGS weights, and return the number of nodes."""
        m = list_nodes(s.change, s.acts, s.acting, s.counts, ACTING, c, me)
        pairs = model.history.shape[1]
        for p in range(me, pairs, threads):
            own = wp.float64(0.0)
            for a in range(3 * m):
                j = 3 * s.acting[c, a // 3] + a % 3
                own += model.history[c, p, j] * s.change[j, c]
            s.x[c, p] = own
        wait()
        for p in range(me, pairs, threads):
            own = wp.float64(0.0)
            for q in range(pairs):
                own += model.middle[c, p, q] * s.x[c, q]
            s.y[c, p] = own
        wait()
        return m

    @wp.func
    def compute_motion(model: ComplianceModel, out: wp.array2d(dtype=wp.float64), s: Scratch, c: int, me: int):
        """Compute the motion of all nodes under the negative force change: out = -C change."""
        m, size = list_changes(model, s, c, me), out.shape[0]
        for first in range(me, size, wide * threads):
            sums = Strip()
            for a in range(m):
                for k in range(3):
                    j = 3 * s.acting[c, a] + k
                    share = s.change[j, c]
                    for q in range(wide):
                        i = wp.min(first + q * threads, size - 1)
                        soft = model.rest[j, i] + get_compliance_change(model, c, j, i)
                        if s.place[i // 3, c] >= 0:
                            soft = get_compliance(model, c, i, j)
                        sums[q] += soft * share
            for p in range(model.history.shape[1]):
                share = s.y[c, p]
                for q in range(wide):
                    sums[q] += model.history[c, p, wp.min(first + q * threads, size - 1)] * share
            for q in range(wide):
                if first + q * threads < size:
                    out[first + q * threads, c] = -sums[q]
        wait()

    @wp.func
    def compute_touched_motion(model: ComplianceModel, size: int, s: Scratch, c: int, me: int):
        """Compute the displacement s.at = C s.change of the touched nodes (`size` rows) under the change of force."""
        m = list_changes(model, s, c, me)
        for i in range(me, size, threads):
            row = 3 * s.touched[c, i // 3] + i % 3
            own = wp.float64(0.0)
            for a in range(3 * m):
                j = 3 * s.acting[c, a // 3] + a % 3
                own += get_compliance(model, c, row, j) * s.change[j, c]
            for p in range(model.history.shape[1]):
                own += model.history[c, p, row] * s.y[c, p]
            s.at[row, c] = own
        wait()

    @wp.func
    def assemble_compliance(model: ComplianceModel, m: int, s: Scratch, c: int, me: int) -> wp.float64:
        """Assemble the compliance matrix of the m touched nodes, and return the mean of its diagonal."""
        pairs = model.history.shape[1]
        for j in range(me, 3 * m, threads):
            row = 3 * s.touched[c, j // 3] + j % 3
            for p in range(pairs):
                own = wp.float64(0.0)
                for q in range(pairs):
                    own += model.middle[c, p, q] * model.history[c, q, row]
                s.middle_history[c, p, j] = own
        wait()
        for i in range(me // across, 3 * m, down):
            first = 3 * s.touched[c, i // 3] + i % 3
            for j in range(i + me % across, 3 * m, across):
                own = get_compliance(model, c, first, 3 * s.touched[c, j // 3] + j % 3)
                for p in range(pairs):
                    own += model.history[c, p, first] * s.middle_history[c, p, j]
                s.soft[c, i, j] = own
        wait()
        own = wp.float64(0.0)
        for i in range(me, 3 * m, threads):
            own += s.soft[c, i, i]
        mean = get_sum(own) / wp.float64(3 * m)
        for i in range(me, 3 * m, threads):
            s.soft[c, i, i] = s.soft[c, i, i] + model.diagonal_shift * mean
        wait()
        return mean

    @wp.func
    def apply_woodbury(m: int, s: Scratch, c: int, me: int) -> bool:
        """Subtract D (1 + C D)^-1 a from the force change, for the compliance C = L L'; return False if not convex.

        This equals D (a - L (1 + L' D L)^-1 L' D a), Woodbury 1950, where a is `at` of the scratch arrays.
        """
        size = 3 * m
        for i in range(me // across, size, down):
            for j in range(me % across, size, across):
                s.both[c, i, j] = wp.float64(0.0)
                s.system[c, i, j] = wp.where(i == j, wp.float64(1.0), wp.float64(0.0))
            for p in range(size):
                share = s.stiff[c, i, p]
                if share != wp.float64(0.0):  # most nodes share no triangle
                    add_row(share, s.soft, p, me % across, p + 1, c, s.both, i)
        wait()
        for i in range(me // across, size, down):
            if threads == 1:
                for p in range(i, size):
                    add_row(s.soft[c, p, i], s.both, p, i, size, c, s.system, i)
            else:  # registers are faster than memory on a GPU
                for first in range(i + me % across, size, wide * across):
                    sums = Strip()
                    for p in range(i, size):
                        share = s.soft[c, p, i]
                        for q in range(wide):
                            sums[q] += share * s.both[c, p, wp.min(first + q * across, size - 1)]
                    for q in range(wide):
                        if first + q * across < size:
                            s.system[c, i, first + q * across] += sums[q]
        for i in range(me, size, threads):
            own = wp.float64(0.0)
            for p in range(size):  # L' D a = (D L)' a
                own += s.both[c, p, i] * s.at[3 * s.touched[c, p / 3] + p % 3, c]
            s.x[c, i] = own
        wait()
        if not factor(s.system, size, c, me):
            return False
        solve(s.system, size, c, me, s.x)
        for i in range(me, size, threads):
            own = s.at[3 * s.touched[c, i // 3] + i % 3, c]
            for p in range(i + 1):
                own -= s.soft[c, i, p] * s.x[c, p]
            s.y[c, i] = own
        wait()
        for i in range(me, size, threads):
            own = wp.float64(0.0)
            for p in range(size):
                own += s.stiff[c, i, p] * s.y[c, p]
            row = 3 * s.touched[c, i // 3] + i % 3
            s.change[row, c] = s.change[row, c] - own
        wait()
        return True

    @wp.func
    def has_all_columns(model: ComplianceModel, m: int, s: Scratch, c: int) -> bool:
        """Return True if the columns of the compliance are available for all touched nodes."""
        missing = wp.int32(0)
        for i in range(m):
            missing += 1 - model.known[s.touched[c, i]]
        return missing == 0

    @forward_kernel(module="unique", launch_bounds=threads)
    def solve_forces(
        positions: wp.array2d(dtype=wp.float64),
        targets: wp.array2d(dtype=wp.float64),
        known_forces: wp.array2d(dtype=wp.float64),
        tolerance: wp.array(dtype=wp.float64),
        proximal: wp.array(dtype=wp.float64),
        first_case: int,
        contact: Contact,
        near: Near,
        model: ComplianceModel,
        limits: Limits,
        s: Scratch,
        # outputs
        out: wp.array2d(dtype=wp.float64),
        status: wp.array(dtype=wp.int32),
    ):
        """Solve for contact forces, as `contact_forces.solve_contact_forces`, in load cases with the status `OPEN`."""
        c, me = wp.tid()
        c = c + first_case
        if status[c] != OPEN:
            return
        size = positions.shape[0]
        for r in range(me, size, threads):
            s.held[r, c] = wp.float64(0.0)
            s.force[r, c] = known_forces[r, c]
            s.w[r, c] = positions[r, c]
        wait()
        compute_gradient(s.w, positions, contact, near, s, c, me)
        m = list_nodes(s.slope, s.place, s.touched, s.counts, TOUCHED, c, me)
        if m > limits.capacity or not has_all_columns(model, m, s, c):
            wait()
            if me == 0:
                status[c] = wp.where(m > limits.capacity, TOO_MANY_TOUCHED, UNKNOWN)
            return
        sound = wp.bool(False)  # True if `soft` holds a valid Cholesky factor
        if m > 0:
            stiff = proximal[c] / assemble_compliance(model, m, s, c, me)
            for i in range(me, 3 * m, threads):
                row = 3 * s.touched[c, i // 3] + i % 3
                s.held[row, c] = stiff
                s.x[c, i] = targets[row, c] - positions[row, c]
            wait()
            sound = factor(s.soft, 3 * m, c, me)
            if sound:
                solve(s.soft, 3 * m, c, me, s.x)
                for i in range(me, 3 * m, threads):
                    row = 3 * s.touched[c, i // 3] + i % 3
                    s.force[row, c] = s.force[row, c] + s.x[c, i]
        wait()
        for r in range(me, size, threads):
            s.change[r, c] = s.force[r, c] - known_forces[r, c]
        wait()
        compute_motion(model, s.at, s, c, me)
        for r in range(me, size, threads):
            s.w[r, c] = targets[r, c] + s.at[r, c]
        wait()
        compute_gradient(s.w, positions, contact, near, s, c, me)
        convex, verdict = wp.bool(True), wp.int32(OPEN)
        for step in range(limits.max_iterations + 1):
            fresh = not has_same_nodes(s.slope, s.place, c, me)
            if fresh:
                m = list_nodes(s.slope, s.place, s.touched, s.counts, TOUCHED, c, me)
            for r in range(me, size, threads):
                s.change[r, c] = s.slope[r, c] - s.force[r, c]
            wait()
            left = dot(s.change, s.change, c, me)
            if left <= tolerance[c] * tolerance[c] * dot(s.slope, s.slope, c, me):
                verdict = wp.int32(SOLVED)
            elif m > limits.capacity:
                verdict = wp.int32(TOO_MANY_TOUCHED)
            elif step == limits.max_iterations or not (convex or step <= limits.nonconvex_iterations):
                verdict = wp.int32(NO_EQUILIBRIUM)
            elif fresh and not has_all_columns(model, m, s, c):
                verdict = wp.int32(UNKNOWN)
            if verdict != OPEN:
                break
            # Residual, and the Newton step of the forces.
            convex = True
            if m > 0:
                compute_touched_motion(model, 3 * m, s, c, me)
                if fresh:
                    assemble_compliance(model, m, s, c, me)
                    sound = factor(s.soft, 3 * m, c, me)
                convex = sound
                if sound:
                    assemble_curvature(contact, near, 0, m, s, c, me)
                    convex = apply_woodbury(m, s, c, me)
                if sound and not convex:  # retry with positive semi-definite contact curvature
                    assemble_curvature(contact, near, 1, m, s, c, me)
                    apply_woodbury(m, s, c, me)
            compute_motion(model, s.way, s, c, me)
            own = wp.float64(0.0)
            for r in range(me, size, threads):
                own += (s.slope[r, c] - s.force[r, c]) * s.way[r, c]
            predicted = -get_sum(own)
            t = bound_step(s.w, s.way, contact, near, c, me)
            for cut in range(limits.max_backtracks + 1):
                for r in range(me, size, threads):
                    s.at[r, c] = s.w[r, c] + t * s.way[r, c]
                wait()
                compute_gradient(s.at, positions, contact, near, s, c, me)
                own = wp.float64(0.0)
                for r in range(me, size, threads):
                    own += (s.slope[r, c] - s.force[r, c] - t * s.change[r, c]) * s.way[r, c]
                ahead = get_sum(own)
                if ahead <= overshoot * wp.abs(predicted) or cut == limits.max_backtracks:
                    break
                share = middle
                if predicted > wp.float64(0.0) and wp.isfinite(ahead):
                    share = wp.clamp(predicted / (predicted + ahead), least, most)
                t = t * share
            for r in range(me, size, threads):
                s.force[r, c] = s.force[r, c] + t * s.change[r, c]
                s.w[r, c] = s.at[r, c]
            wait()
        if verdict == SOLVED:
            for r in range(me, size, threads):
                out[r, c] = s.force[r, c]
        if me == 0:
            status[c] = verdict

    return solve_forces
