"""Search directions of Newton's method, which runs on the host."""

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
    """Search direction d (3N, b) [m]; predicted energy decrease (b,) [J] along d; number of linear iterations."""

    d: wp.array
    decrease: np.ndarray
    iterations: int


class DescentMethod(Protocol):
    """Interface of methods that compute search directions of b load cases, and may keep a state for the batch."""

    def begin(self) -> None:
        """Reset the state for another batch."""
        ...

    def keep(self, device: Device, columns: np.ndarray) -> None:
        """Keep only the load cases `columns` (k,) of the batch."""
        ...

    def find_direction(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, length: np.ndarray
    ) -> Direction:
        """Return the search direction at u (3N, b) with residual g (3N, b) [N].

        `gap` (3N, b) [m], if any, is the motion that satisfies the constraints; the free nodes follow this motion.
        `forcing` (b,) is the maximum linear residual, relative to the right-hand side. `length` (b,) is the accepted
        length of the last direction; if it is zero, the undeformed stiffness replaces the tangent stiffness. The caller
        must not change g or d afterwards.
        """
        ...


class NewtonCG:
    """Inexact Newton directions: K d = -g by truncated conjugate gradients, with a trust radius from accepted steps.

    The radius is in the norm of the preconditioner, and infinite until a step has been shortened (Steihaug 1983). The
    next step may be `radius_growth` times as long as the last accepted step.
    """

    def __init__(self, preconditioner: Preconditioner, max_iterations: int, radius_growth: float = 2.0):
        self._preconditioner, self._most, self._growth = preconditioner, max_iterations, radius_growth
        self.begin()

    def begin(self) -> None:
        """Remove the trust radii, for another batch."""
        self._radius: np.ndarray | None = None
        self._size, self._truncated = np.zeros(0), np.zeros(0, bool)

    def keep(self, device: Device, columns: np.ndarray) -> None:
        """Keep only the trust radii of the load cases `columns` (k,)."""
        if self._radius is not None:
            self._radius, self._size = self._radius[columns], self._size[columns]
            self._truncated = self._truncated[columns]

    def find_direction(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, length: np.ndarray
    ) -> Direction:
        """Return the search direction; see `DescentMethod.find_direction`."""
        device, columns = problem.device, u.shape[1]
        definite = length == 0.0
        problem.linearise(u, definite)
        self._preconditioner.prepare(problem, columns)
        rhs, pulled = compute_right_hand_side(problem, g, gap)
        # No radius where a gap must be closed in full, or where the curvature is that of the undeformed stiffness.
        self._radius = np.where(pulled | definite, np.inf, self._compute_radius(length))
        tolerance = forcing * compute_norms(device, rhs)
        found = solve_conjugate_gradients(
            problem, self._preconditioner, wp.clone(rhs), tolerance, self._most, self._radius
        )
        self._size, self._truncated = found.norm, found.truncated
        predicted = compute_dots(device, rhs, found.x)
        if gap is not None:
            combine_columns(device, found.x, 1.0, gap, found.x)
        return Direction(found.x, predicted, found.iterations)

    def _compute_radius(self, step_length: np.ndarray) -> np.ndarray:
        if self._radius is None:
            return np.full(len(step_length), np.inf)
        step = self._growth * step_length * self._size
        return np.where((step_length == 1.0) & ~self._truncated, np.maximum(self._radius, step), step)


def compute_right_hand_side(problem: Problem, g: wp.array, gap: wp.array | None) -> tuple[wp.array, np.ndarray]:
    """Return -P (g + K gap) (3N, b) [N] at the last linearisation, and a mask (b,) of load cases with a nonzero gap."""
    device, columns = problem.device, g.shape[1]
    rhs = combine_columns(device, device.allocate(*g.shape), -1.0, g, wp.empty_like(g))
    if gap is None:
        return rhs, np.zeros(columns, bool)
    pull = device.allocate(*g.shape)
    problem.add_curvature(gap, pull)
    problem.constraint.project(pull)
    return combine_columns(device, rhs, -1.0, pull, rhs), compute_norms(device, gap) > 0.0
