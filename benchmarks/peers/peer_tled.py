"""Total Lagrangian explicit dynamics (TLED) in Warp: no stiffness, no factor; dynamic relaxation to the equilibrium.

Miller, Joldes, Lance, Wittek 2007, Commun. Numer. Meth. Engng 23:121-134: gradients of the rest shape, lumped mass,
central differences. Joldes, Wittek, Miller 2011, Int. J. Numer. Meth. Biomed. Engng 27:173-185: mass scaling, damping
from the lowest eigenvalue that the motion shows.
"""

import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from benchmarks.peers.engine_process import Case, Solve, serve_loads

wp.config.enable_backward = False
wp.config.log_level = wp.LOG_ERROR

STEPS, EVERY = 10_000, 25
# The critical step is that of undeformed tetrahedra; compressed ones are stiffer, then the step is halved.
SAFETY, SHORTENINGS = 0.9, 4
# Initial estimate of the lowest eigenvalue, relative to the highest; the motion soon gives a better one.
LOWEST = 1e-3


@wp.kernel
def compute_element_forces(
    u: wp.array(dtype=wp.vec3d), tets: wp.array(dtype=wp.vec4i), gradients: wp.array(dtype=wp.mat33d),
    volume: wp.array(dtype=wp.float64), mu: wp.float64, lam: wp.float64,
    # outputs
    forces: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Compute forces [N] of a tetrahedron on its nodes: f_a = -V P grad N_a, P = mu F + (lam ln J - mu) F^-T."""
    t = wp.tid()
    nodes = tets[t]
    G = gradients[t]  # row a: gradient of node a + 1; the gradient of node 0 is minus the sum of the rows
    origin = u[nodes[0]]
    F = wp.identity(n=3, dtype=wp.float64)
    for a in range(3):
        F += wp.outer(u[nodes[a + 1]] - origin, G[a])
    cofactor = wp.matrix_from_rows(wp.cross(F[1], F[2]), wp.cross(F[2], F[0]), wp.cross(F[0], F[1]))
    J = wp.dot(F[0], cofactor[0])
    P = mu * F + ((lam * wp.log(J) - mu) / J) * cofactor
    Q = -volume[t] * P
    first, second, third = Q * G[0], Q * G[1], Q * G[2]
    forces[t, 0] = -(first + second + third)
    forces[t, 1] = first
    forces[t, 2] = second
    forces[t, 3] = third


@wp.kernel
def step_nodes(
    element_forces: wp.array(dtype=wp.vec3d), node_starts: wp.array(dtype=wp.int32), entries: wp.array(dtype=wp.int32),
    load: wp.array(dtype=wp.vec3d), mass: wp.array(dtype=wp.float64), fixed: wp.array(dtype=wp.bool),
    factors: wp.array(dtype=wp.float64),
    # outputs
    u: wp.array(dtype=wp.vec3d), u_previous: wp.array(dtype=wp.vec3d), internal_force: wp.array(dtype=wp.vec3d),
):  # fmt: skip
    """Move a node by one step: u+ = u + beta (u - u-) + alpha M^-1 (f - P(u))."""
    v = wp.tid()
    force = wp.vec3d()
    for i in range(node_starts[v], node_starts[v + 1]):
        force += element_forces[entries[i]]
    internal_force[v] = -force
    if not fixed[v]:
        now = u[v]
        u[v] = now + factors[1] * (now - u_previous[v]) + (factors[0] / mass[v]) * (load[v] + force)
        u_previous[v] = now


@wp.kernel
def sum_squares(
    u: wp.array(dtype=wp.vec3d), internal_force: wp.array(dtype=wp.vec3d), load: wp.array(dtype=wp.vec3d),
    mass: wp.array(dtype=wp.float64), fixed: wp.array(dtype=wp.bool),
    # outputs
    u_last: wp.array(dtype=wp.vec3d), last_force: wp.array(dtype=wp.vec3d), sums: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Sum squares of free residual r, reaction, internal force; -q.dr and qMq of the motion q since the last call."""
    v = wp.tid()
    force = load[v] - internal_force[v]
    wp.atomic_add(sums, 2, wp.dot(internal_force[v], internal_force[v]))
    if fixed[v]:
        wp.atomic_add(sums, 1, wp.dot(force, force))
    else:
        q = u[v] - u_last[v]
        wp.atomic_add(sums, 0, wp.dot(force, force))
        wp.atomic_add(sums, 3, wp.dot(q, last_force[v] - force))
        wp.atomic_add(sums, 4, mass[v] * wp.dot(q, q))
        u_last[v] = u[v]
        last_force[v] = force


def set_up_solver(case: Case, device: str = "cpu") -> Solve:
    """Compute undeformed gradients, masses and the tetrahedra around each node, for all loads."""
    count, size = len(case.tets), len(case.nodes)
    edges = np.swapaxes(case.nodes[case.tets[:, 1:]] - case.nodes[case.tets[:, :1]], 1, 2)
    gradients, volume = np.linalg.inv(edges), np.linalg.det(edges) / 6.0
    # No eigenvalue of an element's stiffness is above (lam + 2 mu) V sum |grad N|^2: with this mass all are <= 1.
    square = (gradients**2).sum(axis=(1, 2)) + (gradients.sum(axis=1) ** 2).sum(axis=1)
    mass = np.bincount(case.tets.ravel(), np.repeat((case.lam + 2.0 * case.mu) * volume * square, 4), size)
    starts = np.concatenate([[0], np.cumsum(np.bincount(case.tets.ravel(), minlength=size))])

    def array(values: np.ndarray, kind: type) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

    def command(kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> wp.Launch:
        return wp.launch(kernel, dim, inputs, outputs, device=device, record_cmd=True)

    around = [array(starts, wp.int32), array(np.argsort(case.tets.ravel(), kind="stable"), wp.int32)]
    shape = [array(case.tets, wp.vec4i), array(gradients, wp.mat33d), array(volume, wp.float64)]
    fixed = [array(mass, wp.float64), array(case.held, wp.bool)]
    u, before, inner, load, *last = (wp.zeros(size, dtype=wp.vec3d, device=device) for _ in range(6))
    pulls = wp.zeros((count, 4), dtype=wp.vec3d, device=device)
    factors, sums = (wp.zeros(length, dtype=wp.float64, device=device) for length in (2, 5))
    pulling = command(compute_element_forces, count, [u, *shape, wp.float64(case.mu), wp.float64(case.lam)], [pulls])
    moving = command(step_nodes, size, [pulls.flatten(), *around, load, *fixed, factors], [u, before, inner])
    measuring = command(sum_squares, size, [before, inner, load, *fixed], [*last, sums])

    def steps() -> None:
        """Run several steps, and compute the sums at the state before the last step."""
        for _ in range(EVERY):
            pulling.launch()
            moving.launch()
        sums.zero_()
        measuring.launch()

    go = _captured(steps, device)

    def relax(force: np.ndarray, step: float) -> tuple[float, int]:
        """Iterate to equilibrium; return relative residual (not finite where the law is) and number of steps."""
        for place in (u, before):
            place.zero_()
        load.assign(force)
        lowest, left, outer = LOWEST, np.inf, float(np.square(force).sum())
        for done in range(EVERY, STEPS + 1, EVERY):
            damping = 2.0 * np.sqrt(lowest) * step
            factors.assign(np.array([2.0 * step**2, 2.0 - damping]) / (2.0 + damping))
            go()
            residual, reaction, inside, change, motion = sums.numpy()
            left = float(np.sqrt(residual / max(reaction, inside, outer)))
            if not np.isfinite(left) or left <= case.tolerance:
                return left, done
            # Rayleigh quotient of the last motion; the first motion has no earlier state.
            if done > EVERY and 0.0 < change < motion:
                lowest = change / motion
        return left, STEPS

    def solve(force: np.ndarray) -> np.ndarray:
        step = 2.0 * SAFETY
        for _ in range(SHORTENINGS):
            left, done = relax(force, step)
            if left <= case.tolerance:
                return before.numpy()
            if np.isfinite(left):
                raise RuntimeError(f"not reached in {done} steps: {left:.1e}")
            step *= 0.5
        raise RuntimeError(f"unstable at 1/{2 ** (SHORTENINGS - 1)} of the critical step")

    return solve


def _captured(steps: Callable[[], None], device: str) -> Callable[[], None]:
    """Capture the steps as one CUDA graph; on the CPU, return them unchanged."""
    if device == "cpu":
        return steps
    steps()  # load kernels before the capture, undeformed and without a load
    with wp.ScopedCapture(device=device) as capture:
        steps()
    return lambda: wp.capture_launch(capture.graph)


if __name__ == "__main__":
    serve_loads(partial(set_up_solver, device="cuda" if "cuda" in sys.argv else "cpu"))
