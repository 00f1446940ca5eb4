"""Search directions of the outer iteration that the host steers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..linalg.pcg import Preconditioner, solve_conjugate_gradients
from ..runtime.columns import combine_columns, compute_dots, compute_norms
from ..runtime.device import Device


@dataclass(frozen=True, eq=False)
class Direction:
    """d (3N, b) [m]; the decrease (b,) [J] that the linear model promises along it; linear iterations spent."""

    d: wp.array
    promised: np.ndarray
    iterations: int


class Descent(Protocol):
    """Where to go next, for b load cases at once; it remembers what it has learnt from a batch."""

    def begin(self) -> None:
        """Forget: another batch begins."""
        ...

    def keep(self, device: Device, columns: np.ndarray) -> None:
        """Keep these columns (k,): the others have left the batch."""
        ...

    def find(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, taken: np.ndarray
    ) -> Direction:
        """Direction at u (3N, b) with free gradient g (3N, b) [N].

        `gap` (3N, b) [m], if any, is the motion that closes the constraints; the free nodes follow it. `forcing` (b,):
        the linear residual that may be left, relative to the right-hand side. `taken` (b,): the share of the last
        direction that was gone; where it was none, the curvature at rest stands in for one that misled. Nobody changes
        g after the call, nor d.
        """
        ...


class NewtonCG:
    """Inexact Newton: K d = -g by truncated conjugate gradients, within a radius that follows the steps taken.

    The radius is in the preconditioner's norm, and infinite until a step has been cut: Steihaug 1983. The next step may
    be `growth` times as long as the one that was taken.
    """

    def __init__(self, preconditioner: Preconditioner, most: int, growth: float = 2.0):
        self._preconditioner, self._most, self._growth = preconditioner, most, growth
        self.begin()

    def begin(self) -> None:
        """No radius yet."""
        self._radius: np.ndarray | None = None
        self._size, self._truncated = np.zeros(0), np.zeros(0, bool)

    def keep(self, device: Device, columns: np.ndarray) -> None:
        """Keep the radii of these columns (k,)."""
        if self._radius is not None:
            self._radius, self._size = self._radius[columns], self._size[columns]
            self._truncated = self._truncated[columns]

    def find(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, taken: np.ndarray
    ) -> Direction:
        """As `Descent`."""
        device, columns = problem.device, u.shape[1]
        definite = taken == 0.0
        problem.linearise(u, definite)
        self._preconditioner.prepare(problem, columns)
        rhs, pulled = compute_right_hand_side(problem, g, gap)
        # What follows a gap must follow it whole, and the curvature at rest misleads no one.
        self._radius = np.where(pulled | definite, np.inf, self._followed(taken))
        tolerance = forcing * compute_norms(device, rhs)
        found = solve_conjugate_gradients(
            problem, self._preconditioner, wp.clone(rhs), tolerance, self._most, self._radius
        )
        self._size, self._truncated = found.size, found.truncated
        promised = compute_dots(device, rhs, found.x)
        return Direction(close_constraints(device, found.x, gap), promised, found.iterations)

    def _followed(self, taken: np.ndarray) -> np.ndarray:
        if self._radius is None:
            return np.full(len(taken), np.inf)
        step = self._growth * taken * self._size
        return np.where((taken == 1.0) & ~self._truncated, np.maximum(self._radius, step), step)


def compute_right_hand_side(problem: Problem, g: wp.array, gap: wp.array | None) -> tuple[wp.array, np.ndarray]:
    """-P (g + K gap) (3N, b) [N] at the last linearisation, and which columns (b,) have a gap to close."""
    device, columns = problem.device, g.shape[1]
    rhs = combine_columns(device, device.zeros(*g.shape), -1.0, g, wp.empty_like(g))
    if gap is None:
        return rhs, np.zeros(columns, bool)
    pull = device.zeros(*g.shape)
    problem.add_curvature(gap, pull)
    problem.constraint.project(pull)
    return combine_columns(device, rhs, -1.0, pull, rhs), compute_norms(device, gap) > 0.0


def close_constraints(device: Device, x: wp.array, gap: wp.array | None) -> wp.array:
    """x (3N, b) and, if any, the motion that closes the constraints, in place."""
    return x if gap is None else combine_columns(device, x, 1.0, gap, x)
