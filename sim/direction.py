"""Search directions of the outer iteration: small classes, chosen by measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from .columns import combined, dots, norms
from .linear import Preconditioner, conjugate_gradients
from .problem import Problem


@dataclass(frozen=True, eq=False)
class Direction:
    """d (3N, b) [m]; the decrease (b,) [J] that the linear model promises along it; linear iterations spent."""

    d: wp.array
    promised: np.ndarray
    iterations: int


@dataclass(frozen=True, eq=False)
class NewtonCG:
    """Inexact Newton: K d = -g by truncated conjugate gradients, and full closure of the constraints' gap."""

    preconditioner: Preconditioner
    most: int

    def find(
        self,
        problem: Problem,
        u: wp.array,
        g: wp.array,
        gap: wp.array | None,
        forcing: np.ndarray,
        definite: np.ndarray,
    ) -> Direction:
        """Direction at u (3N, b) with free gradient g (3N, b) [N].

        `forcing` (b,): the linear residual that is left, relative to the right-hand side. `gap` (3N, b) [m], if any,
        is the motion that closes the constraints; the free nodes follow it.
        """
        device, columns = problem.device, u.shape[1]
        problem.linearise(u, definite)
        self.preconditioner.prepare(problem, columns)
        minus = np.full(columns, -1.0)
        rhs = combined(device, device.zeros(*g.shape), minus, g, device.zeros(*g.shape))
        if gap is not None:
            pull = device.zeros(*g.shape)
            problem.add_curvature(gap, pull)
            problem.constraint.project(pull)
            combined(device, rhs, minus, pull, rhs)
        tolerance = forcing * norms(device, rhs)
        solution = conjugate_gradients(problem, self.preconditioner, wp.clone(rhs), tolerance, self.most)
        promised = dots(device, rhs, solution.x)
        d = solution.x if gap is None else combined(device, solution.x, np.ones(columns), gap, solution.x)
        return Direction(d, promised, solution.iterations)
