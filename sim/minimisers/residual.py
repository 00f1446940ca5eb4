"""Residual: gradient of the energy at the free unknowns, and the force scale for relative residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..runtime.columns import CHUNK, add_dots, combine_columns, gather_columns
from ..runtime.device import Device
from . import lbfgs_trial_kernels
from .lbfgs_kernels import FREE, OWN, PAIRS, SUMS, WHOLE, build_kernels


@dataclass(frozen=True, eq=False)
class ResidualArrays:
    """Residual g (3N, b) [N] on the device, and the `sums` (SUMS, b) on which the decisions of L-BFGS depend.

    `term_norms` (terms, b) are squared norms of the gradients of all terms that are not constant. `scratch` (3N, b) is
    a workspace that is zero between calls.
    """

    g: wp.array
    scratch: wp.array
    sums: wp.array
    term_norms: wp.array


def allocate_residual_arrays(problem: Problem, count: int) -> ResidualArrays:
    """Return allocated `ResidualArrays` for `count` load cases."""
    device = problem.device
    sums, own = (wp.zeros((rows, count), dtype=wp.float64, device=device.name) for rows in (SUMS, len(problem.terms)))
    return ResidualArrays(device.allocate(problem.rows, count), device.allocate(problem.rows, count), sums, own)


def compute_residual_arrays(
    problem: Problem,
    v: wp.array,
    constant_gradients: wp.array,
    d: wp.array | None = None,
    workspace: ResidualArrays | None = None,
) -> ResidualArrays:
    """Return the residual at v (3N, b) [m] with `constant_gradients` (3N, b) [N], and its inner products with d.

    The result is written to `workspace`, if it is given.
    """
    device, (rows, count) = problem.device, v.shape
    workspace = workspace or allocate_residual_arrays(problem, count)
    varying = [term for term in problem.terms if not term.constant]
    workspace.sums.zero_()
    wp.copy(workspace.g, constant_gradients)
    if len(varying) == 1:
        varying[0].add_gradient(v, workspace.g)
        workspace = replace(workspace, term_norms=workspace.sums[OWN : OWN + 1])
    else:
        absorb = build_kernels(device, PAIRS).add_gradient
        workspace.term_norms.zero_()
        for number, term in enumerate(varying):
            term.add_gradient(v, workspace.scratch)
            outputs = [workspace.scratch, workspace.g, workspace.term_norms[number]]
            device.launch(absorb, (-(-rows // CHUNK), count), [], outputs)
    inputs = [constant_gradients, *problem.constraint.node_arrays, v if d is None else d]
    spread = lbfgs_trial_kernels.choose_thread_spread(device, count)
    device.launch(
        lbfgs_trial_kernels.build_kernels(device, spread).project_gradient,
        (spread.count_threads(rows // 3), count),
        inputs,
        [workspace.g, workspace.sums],
    )
    return workspace


def compute_constant_gradients(problem: Problem, u: wp.array) -> tuple[wp.array, wp.array]:
    """Return the sum (3N, b) [N] of the gradients of constant terms, and their squared norms (terms, b)."""
    device = problem.device
    total = device.allocate(*u.shape)
    square = wp.zeros((len(problem.terms), u.shape[1]), dtype=wp.float64, device=device.name)
    for number, term in enumerate(problem.terms):
        if term.constant:
            own = device.allocate(*u.shape)
            term.add_gradient(u, own)
            add_dots(device, own, own, square[number])
            combine_columns(device, total, 1.0, own, total)
    return total, square


@dataclass(frozen=True, eq=False)
class ResidualState:
    """State of b load cases: u (3N, b) [m], residual g (3N, b) [N], its 2-norm `norm` (b,), and its `scale` (b,).

    The scale [N] is the largest 2-norm among the gradients of all terms and the reaction at constrained nodes.
    """

    u: wp.array
    g: wp.array
    norm: np.ndarray
    scale: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Relative residual (b,) of each load case."""
        return compute_relative_residual(self.norm, self.scale)

    @property
    def is_finite(self) -> np.ndarray:
        """Mask (b,) of load cases with finite residual and scale, since forces may overflow."""
        return np.isfinite(self.norm) & np.isfinite(self.scale)

    def select(self, device: Device, columns: np.ndarray) -> ResidualState:
        """Return the state of the load cases `columns` (k,)."""
        u, g = (gather_columns(device, array, columns) for array in (self.u, self.g))
        return ResidualState(u, g, self.norm[columns], self.scale[columns])


@dataclass(frozen=True, eq=False)
class ResidualEvaluator:
    """Callable that evaluates the residuals of the current batch of a problem.

    `constant` (3N, b) [N] is the summed gradient of the constant terms; `norms` (b,) are their largest squared norms.
    """

    problem: Problem
    constant: wp.array
    norms: np.ndarray

    def __call__(self, u: wp.array) -> ResidualState:
        """Return the state with the residuals at u (3N, b) [m]."""
        found = compute_residual_arrays(self.problem, u, self.constant)
        sums = found.sums.numpy()
        with np.errstate(invalid="ignore", over="ignore"):
            largest = np.maximum(self.norms, found.term_norms.numpy().max(axis=0, initial=0.0))
            largest = np.maximum(largest, sums[WHOLE] - sums[FREE])
            return ResidualState(u, found.g, np.sqrt(sums[FREE]), np.sqrt(largest))

    def select(self, columns: np.ndarray) -> ResidualEvaluator:
        """Keep only the load cases `columns` (k,), also in the problem, and return their evaluator."""
        self.problem.keep(columns)
        return ResidualEvaluator(
            self.problem, gather_columns(self.problem.device, self.constant, columns), self.norms[columns]
        )


def build_evaluator(problem: Problem, u: wp.array) -> ResidualEvaluator:
    """Return the evaluator of the current batch of a problem, with start u (3N, b) [m]."""
    constant, loud = compute_constant_gradients(problem, u)
    return ResidualEvaluator(problem, constant, loud.numpy().max(axis=0, initial=0.0))


def compute_relative_residual(norm: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return residual norms (b,) [N] divided by their scales (b,) [N]; zero if no force acts."""
    with np.errstate(invalid="ignore"):  # forces that overflowed
        return np.divide(norm, scale, out=np.zeros_like(norm), where=scale != 0.0)


def measure_residual(problem: Problem, u: wp.array) -> np.ndarray:
    """Return the relative residual (b,) of u (3N, b) under the full load, or the relative constraint gap if larger."""
    _, free, scale = problem.residual(u)
    gap, size = problem.constraint.close_gap(u)
    largest = np.abs(u.numpy() + gap.numpy()).max(axis=0, initial=0.0)
    worse = np.maximum(compute_relative_residual(free, scale), compute_relative_residual(size, largest))
    return np.where(np.isnan(worse), np.inf, worse)
