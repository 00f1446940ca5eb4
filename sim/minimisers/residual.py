"""What is out of balance in a state: the free gradient of the potential, and what it is measured against."""

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
class Balance:
    """What is out of balance: the free gradient g (3N, b) [N] on the device, and the `sums` (SUMS, b) that steer.

    Square norms own (b last) of the gradients of the terms that are not constant. `part` (3N, b) is zero between.
    """

    g: wp.array
    part: wp.array
    sums: wp.array
    own: wp.array


def allocate_balance(problem: Problem, count: int) -> Balance:
    """Arrays for the balance of so many columns."""
    device = problem.device
    sums, own = (wp.zeros((rows, count), dtype=wp.float64, device=device.name) for rows in (SUMS, len(problem.terms)))
    return Balance(device.zeros(problem.rows, count), device.zeros(problem.rows, count), sums, own)


def compute_balance(
    problem: Problem, v: wp.array, constant: wp.array, d: wp.array | None = None, workspace: Balance | None = None
) -> Balance:
    """The balance at v (3N, b) [m] of a batch with `constant` gradients (3N, b) [N], and its slope along d (3N, b).

    In the arrays of `workspace`, if it is given.
    """
    device, (rows, count) = problem.device, v.shape
    workspace = workspace or allocate_balance(problem, count)
    varying = [term for term in problem.terms if not term.constant]
    workspace.sums.zero_()
    wp.copy(workspace.g, constant)
    if len(varying) == 1:
        varying[0].add_gradient(v, workspace.g)
        workspace = replace(workspace, own=workspace.sums[OWN : OWN + 1])
    else:
        absorb = build_kernels(device, PAIRS).absorb
        workspace.own.zero_()
        for number, term in enumerate(varying):
            term.add_gradient(v, workspace.part)
            device.launch(absorb, (-(-rows // CHUNK), count), [], [workspace.part, workspace.g, workspace.own[number]])
    inputs = [constant, *problem.constraint.nodes, v if d is None else d]
    spread = lbfgs_trial_kernels.spread_of(device, count)
    device.launch(
        lbfgs_trial_kernels.build_kernels(device, spread).finish,
        (spread.threads(rows // 3), count),
        inputs,
        [workspace.g, workspace.sums],
    )
    return workspace


def compute_constant_gradients(problem: Problem, u: wp.array) -> tuple[wp.array, wp.array]:
    """The summed gradient (3N, b) [N] of the terms that are constant, and the square norm (terms, b) of each one's."""
    device = problem.device
    total = device.zeros(*u.shape)
    square = wp.zeros((len(problem.terms), u.shape[1]), dtype=wp.float64, device=device.name)
    for number, term in enumerate(problem.terms):
        if term.constant:
            own = device.zeros(*u.shape)
            term.add_gradient(u, own)
            add_dots(device, own, own, square[number])
            combine_columns(device, total, 1.0, own, total)
    return total, square


@dataclass(frozen=True, eq=False)
class ResidualState:
    """Where b columns are: u (3N, b) [m], free gradients g (3N, b) [N], their 2-norms `free` (b,), and `scale` (b,).

    The scale [N] is what free gradients are measured against.
    """

    u: wp.array
    g: wp.array
    free: np.ndarray
    scale: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """The relative residuals (b,)."""
        return compute_relative(self.free, self.scale)

    @property
    def finite(self) -> np.ndarray:
        """(b,) bool: whether each is a state at all. Forces that overflow have no scale."""
        return np.isfinite(self.free) & np.isfinite(self.scale)

    def rows(self, device: Device, stay: np.ndarray) -> ResidualState:
        """Return some of the columns (k,)."""
        u, g = (gather_columns(device, array, stay) for array in (self.u, self.g))
        return ResidualState(u, g, self.free[stay], self.scale[stay])


@dataclass(frozen=True, eq=False)
class Judge:
    """Measures states of the batch that a problem has begun.

    The gradient (3N, b) [N] of its terms that are constant, and the largest square norm (b,) of one of these.
    """

    problem: Problem
    constant: wp.array
    square: np.ndarray

    def __call__(self, u: wp.array) -> ResidualState:
        """Return the states u (3N, b) [m]."""
        found = compute_balance(self.problem, u, self.constant)
        sums = found.sums.numpy()
        with np.errstate(invalid="ignore", over="ignore"):
            largest = np.maximum(self.square, found.own.numpy().max(axis=0, initial=0.0))
            largest = np.maximum(largest, sums[WHOLE] - sums[FREE])
            return ResidualState(u, found.g, np.sqrt(sums[FREE]), np.sqrt(largest))

    def rows(self, stay: np.ndarray) -> Judge:
        """Of some of the columns (k,), which are all that the problem keeps from now on."""
        self.problem.keep(stay)
        return Judge(self.problem, gather_columns(self.problem.device, self.constant, stay), self.square[stay])


def build_judge(problem: Problem, u: wp.array) -> Judge:
    """Of the batch that the problem has begun, about to start at u (3N, b) [m]."""
    constant, loud = compute_constant_gradients(problem, u)
    return Judge(problem, constant, loud.numpy().max(axis=0, initial=0.0))


def compute_relative(free: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Free gradients (b,) [N] over the norms that they are measured against (b,); zero where nothing acts."""
    with np.errstate(invalid="ignore"):  # forces that overflowed
        return np.divide(free, scale, out=np.zeros_like(free), where=scale != 0.0)


def measure_residual(problem: Problem, u: wp.array) -> np.ndarray:
    """The relative residual (b,) of u (3N, b) under the whole load, or the share of imposed motion that is missing."""
    _, free, scale = problem.residual(u)
    gap, size = problem.constraint.close_gap(u)
    largest = np.abs(u.numpy() + gap.numpy()).max(axis=0, initial=0.0)
    worse = np.maximum(compute_relative(free, scale), compute_relative(size, largest))
    return np.where(np.isnan(worse), np.inf, worse)
