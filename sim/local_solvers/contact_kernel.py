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
    def dot(x: wp.array2d(dtype=wp.float64), y: wp.array2d(dtype=wp.float64), c: int, thread: int) -> wp.float64:
        """Return the inner product x . y of a load case, computed by all threads of the block."""
        own = wp.float64(0.0)
        for r in range(thread, x.shape[0], threads):
            own += x[r, c] * y[r, c]
        return get_sum(own)

    @wp.func
    def is_nonzero(x: wp.array2d(dtype=wp.float64), i: int, c: int) -> bool:
        """Return True if x is not zero at node i."""
        zero = wp.float64(0.0)
        return x[3 * i, c] != zero or x[3 * i + 1, c] != zero or x[3 * i + 2, c] != zero

    @wp.func
    def has_same_nodes(x: wp.array2d(dtype=wp.float64), index: wp.array2d(dtype=wp.int32), c: int, thread: int) -> bool:
        """Return True if x is nonzero at exactly those nodes whose index in `index` is not -1."""
        other = wp.float64(0.0)
        for i in range(thread, index.shape[0], threads):
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
        thread: int,
    ) -> int:
        """List the nodes with nonzero x in ascending order, set `index` (-1 for others), and return their number."""
        n = index.shape[0]
        own = (n + threads - 1) // threads
        begin, end = wp.min(thread * own, n), wp.min((thread + 1) * own, n)
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
        if thread == threads - 1:
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
        thread: int,
    ):
        """Compute the gradient of the barrier and of the proximal term at x."""
        for r in range(thread, x.shape[0], threads):
            s.gradient[r, c] = s.proximal[r, c] * (x[r, c] - positions[r, c])
        add_force(x, contact, near, c, thread, s.gradient)

    @wp.func
    def assemble_curvature(contact: Contact, near: Near, definite: int, m: int, s: Scratch, c: int, thread: int):
        """Assemble the curvature matrix of the barrier and of the proximal term at w, for the m touched nodes."""
        for i in range(thread // across, 3 * m, down):
            for j in range(thread % across, 3 * m, across):
                s.stiffness[c, i, j] = wp.float64(0.0)
        wait()
        add_matrix(s.w, contact, near, definite, s.touched_index, c, thread, s.stiffness)
        for i in range(thread, 3 * m, threads):
            s.stiffness[c, i, i] = s.stiffness[c, i, i] + s.proximal[3 * s.touched_nodes[c, i // 3] + i % 3, c]
        wait()

    @wp.func
    def get_compliance_change(model: ComplianceModel, c: int, i: int, j: int) -> wp.float64:
        """Return an entry of the change of the compliance by strained tissue."""
        own = wp.float64(0.0)
        if model.strain_change.shape[1] > 0:
            own = wp.float64(model.strain_change[c, i, j])
        return own

    @wp.func
    def get_compliance(model: ComplianceModel, c: int, i: int, j: int) -> wp.float64:
        """Return a compliance entry of touched nodes, symmetrised, since half precision may round the columns."""
        mean = wp.float64(0.5) * (model.undeformed[i, j] + model.undeformed[j, i])
        return mean + get_compliance_change(model, c, i, j)

    @wp.func
    def list_changes(model: ComplianceModel, s: Scratch, c: int, thread: int) -> int:
        """List the nodes on which the force change acts, compute its L-BFGS weights, and return the number of nodes."""
        m = list_nodes(s.force_change, s.acting_index, s.acting_nodes, s.counts, ACTING, c, thread)
        pairs = model.history.shape[1]
        for p in range(thread, pairs, threads):
            own = wp.float64(0.0)
            for a in range(3 * m):
                j = 3 * s.acting_nodes[c, a // 3] + a % 3
                own += model.history[c, p, j] * s.force_change[j, c]
            s.x[c, p] = own
        wait()
        for p in range(thread, pairs, threads):
            own = wp.float64(0.0)
            for q in range(pairs):
                own += model.middle_matrix[c, p, q] * s.x[c, q]
            s.y[c, p] = own
        wait()
        return m

    @wp.func
    def compute_motion(model: ComplianceModel, out: wp.array2d(dtype=wp.float64), s: Scratch, c: int, thread: int):
        """Compute the motion of all nodes under the negative force change: out = -C change."""
        m, size = list_changes(model, s, c, thread), out.shape[0]
        for first in range(thread, size, wide * threads):
            sums = Strip()
            for a in range(m):
                for k in range(3):
                    j = 3 * s.acting_nodes[c, a] + k
                    share = s.force_change[j, c]
                    for q in range(wide):
                        i = wp.min(first + q * threads, size - 1)
                        soft = model.undeformed[j, i] + get_compliance_change(model, c, j, i)
                        if s.touched_index[i // 3, c] >= 0:
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
    def compute_touched_motion(model: ComplianceModel, size: int, s: Scratch, c: int, thread: int):
        """Compute the displacement s.trial = C s.force_change of the touched nodes (`size` rows)."""
        m = list_changes(model, s, c, thread)
        for i in range(thread, size, threads):
            row = 3 * s.touched_nodes[c, i // 3] + i % 3
            own = wp.float64(0.0)
            for a in range(3 * m):
                j = 3 * s.acting_nodes[c, a // 3] + a % 3
                own += get_compliance(model, c, row, j) * s.force_change[j, c]
            for p in range(model.history.shape[1]):
                own += model.history[c, p, row] * s.y[c, p]
            s.trial[row, c] = own
        wait()

    @wp.func
    def assemble_compliance(model: ComplianceModel, m: int, s: Scratch, c: int, thread: int) -> wp.float64:
        """Assemble the compliance matrix of the m touched nodes, and return the mean of its diagonal."""
        pairs = model.history.shape[1]
        for j in range(thread, 3 * m, threads):
            row = 3 * s.touched_nodes[c, j // 3] + j % 3
            for p in range(pairs):
                own = wp.float64(0.0)
                for q in range(pairs):
                    own += model.middle_matrix[c, p, q] * model.history[c, q, row]
                s.middle_history[c, p, j] = own
        wait()
        for i in range(thread // across, 3 * m, down):
            first = 3 * s.touched_nodes[c, i // 3] + i % 3
            for j in range(i + thread % across, 3 * m, across):
                own = get_compliance(model, c, first, 3 * s.touched_nodes[c, j // 3] + j % 3)
                for p in range(pairs):
                    own += model.history[c, p, first] * s.middle_history[c, p, j]
                s.compliance[c, i, j] = own
        wait()
        own = wp.float64(0.0)
        for i in range(thread, 3 * m, threads):
            own += s.compliance[c, i, i]
        mean = get_sum(own) / wp.float64(3 * m)
        for i in range(thread, 3 * m, threads):
            s.compliance[c, i, i] = s.compliance[c, i, i] + model.diagonal_shift * mean
        wait()
        return mean

    @wp.func
    def apply_woodbury(m: int, s: Scratch, c: int, thread: int) -> bool:
        """Subtract D (1 + C D)^-1 a from the force change, for the compliance C = L L'; return False if not convex.

        This equals D (a - L (1 + L' D L)^-1 L' D a), Woodbury 1950, where a is `trial` of the scratch arrays.
        """
        size = 3 * m
        for i in range(thread // across, size, down):
            for j in range(thread % across, size, across):
                s.product[c, i, j] = wp.float64(0.0)
                s.system[c, i, j] = wp.where(i == j, wp.float64(1.0), wp.float64(0.0))
            for p in range(size):
                share = s.stiffness[c, i, p]
                if share != wp.float64(0.0):  # most nodes share no triangle
                    add_row(share, s.compliance, p, thread % across, p + 1, c, s.product, i)
        wait()
        for i in range(thread // across, size, down):
            if threads == 1:
                for p in range(i, size):
                    add_row(s.compliance[c, p, i], s.product, p, i, size, c, s.system, i)
            else:  # registers are faster than memory on a GPU
                for first in range(i + thread % across, size, wide * across):
                    sums = Strip()
                    for p in range(i, size):
                        share = s.compliance[c, p, i]
                        for q in range(wide):
                            sums[q] += share * s.product[c, p, wp.min(first + q * across, size - 1)]
                    for q in range(wide):
                        if first + q * across < size:
                            s.system[c, i, first + q * across] += sums[q]
        for i in range(thread, size, threads):
            own = wp.float64(0.0)
            for p in range(size):  # L' D a = (D L)' a
                own += s.product[c, p, i] * s.trial[3 * s.touched_nodes[c, p / 3] + p % 3, c]
            s.x[c, i] = own
        wait()
        if not factor(s.system, size, c, thread):
            return False
        solve(s.system, size, c, thread, s.x)
        for i in range(thread, size, threads):
            own = s.trial[3 * s.touched_nodes[c, i // 3] + i % 3, c]
            for p in range(i + 1):
                own -= s.compliance[c, i, p] * s.x[c, p]
            s.y[c, i] = own
        wait()
        for i in range(thread, size, threads):
            own = wp.float64(0.0)
            for p in range(size):
                own += s.stiffness[c, i, p] * s.y[c, p]
            row = 3 * s.touched_nodes[c, i // 3] + i % 3
            s.force_change[row, c] = s.force_change[row, c] - own
        wait()
        return True

    @wp.func
    def has_all_columns(model: ComplianceModel, m: int, s: Scratch, c: int) -> bool:
        """Return True if the columns of the compliance are available for all touched nodes."""
        missing = wp.int32(0)
        for i in range(m):
            missing += 1 - model.has_columns[s.touched_nodes[c, i]]
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
        c, thread = wp.tid()
        c = c + first_case
        if status[c] != OPEN:
            return
        size = positions.shape[0]
        for r in range(thread, size, threads):
            s.proximal[r, c] = wp.float64(0.0)
            s.force[r, c] = known_forces[r, c]
            s.w[r, c] = positions[r, c]
        wait()
        compute_gradient(s.w, positions, contact, near, s, c, thread)
        m = list_nodes(s.gradient, s.touched_index, s.touched_nodes, s.counts, TOUCHED, c, thread)
        if m > limits.capacity or not has_all_columns(model, m, s, c):
            wait()
            if thread == 0:
                status[c] = wp.where(m > limits.capacity, TOO_MANY_TOUCHED, UNKNOWN)
            return
        sound = wp.bool(False)  # True if `compliance` holds a valid Cholesky factor
        if m > 0:
            stiff = proximal[c] / assemble_compliance(model, m, s, c, thread)
            for i in range(thread, 3 * m, threads):
                row = 3 * s.touched_nodes[c, i // 3] + i % 3
                s.proximal[row, c] = stiff
                s.x[c, i] = targets[row, c] - positions[row, c]
            wait()
            sound = factor(s.compliance, 3 * m, c, thread)
            if sound:
                solve(s.compliance, 3 * m, c, thread, s.x)
                for i in range(thread, 3 * m, threads):
                    row = 3 * s.touched_nodes[c, i // 3] + i % 3
                    s.force[row, c] = s.force[row, c] + s.x[c, i]
        wait()
        for r in range(thread, size, threads):
            s.force_change[r, c] = s.force[r, c] - known_forces[r, c]
        wait()
        compute_motion(model, s.trial, s, c, thread)
        for r in range(thread, size, threads):
            s.w[r, c] = targets[r, c] + s.trial[r, c]
        wait()
        compute_gradient(s.w, positions, contact, near, s, c, thread)
        convex, verdict = wp.bool(True), wp.int32(OPEN)
        for step in range(limits.max_iterations + 1):
            fresh = not has_same_nodes(s.gradient, s.touched_index, c, thread)
            if fresh:
                m = list_nodes(s.gradient, s.touched_index, s.touched_nodes, s.counts, TOUCHED, c, thread)
            for r in range(thread, size, threads):
                s.force_change[r, c] = s.gradient[r, c] - s.force[r, c]
            wait()
            left = dot(s.force_change, s.force_change, c, thread)
            if left <= tolerance[c] * tolerance[c] * dot(s.gradient, s.gradient, c, thread):
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
                compute_touched_motion(model, 3 * m, s, c, thread)
                if fresh:
                    assemble_compliance(model, m, s, c, thread)
                    sound = factor(s.compliance, 3 * m, c, thread)
                convex = sound
                if sound:
                    assemble_curvature(contact, near, 0, m, s, c, thread)
                    convex = apply_woodbury(m, s, c, thread)
                if sound and not convex:  # retry with positive semi-definite contact curvature
                    assemble_curvature(contact, near, 1, m, s, c, thread)
                    apply_woodbury(m, s, c, thread)
            compute_motion(model, s.direction, s, c, thread)
            own = wp.float64(0.0)
            for r in range(thread, size, threads):
                own += (s.gradient[r, c] - s.force[r, c]) * s.direction[r, c]
            predicted = -get_sum(own)
            t = bound_step(s.w, s.direction, contact, near, c, thread)
            for cut in range(limits.max_backtracks + 1):
                for r in range(thread, size, threads):
                    s.trial[r, c] = s.w[r, c] + t * s.direction[r, c]
                wait()
                compute_gradient(s.trial, positions, contact, near, s, c, thread)
                own = wp.float64(0.0)
                for r in range(thread, size, threads):
                    own += (s.gradient[r, c] - s.force[r, c] - t * s.force_change[r, c]) * s.direction[r, c]
                ahead = get_sum(own)
                if ahead <= overshoot * wp.abs(predicted) or cut == limits.max_backtracks:
                    break
                share = middle
                if predicted > wp.float64(0.0) and wp.isfinite(ahead):
                    share = wp.clamp(predicted / (predicted + ahead), least, most)
                t = t * share
            for r in range(thread, size, threads):
                s.force[r, c] = s.force[r, c] + t * s.force_change[r, c]
                s.w[r, c] = s.trial[r, c]
            wait()
        if verdict == SOLVED:
            for r in range(thread, size, threads):
                out[r, c] = s.force[r, c]
        if thread == 0:
            status[c] = verdict

    return solve_forces
