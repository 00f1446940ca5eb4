"""Answers of the stiffness at rest alone, in the solver's own precision: what a series is made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..errors import InputError
from ..runtime.columns import compute_norms
from .pcg import Preconditioner, solve_conjugate_gradients
from .preconditioner import build_rest_solver, is_exact


@dataclass(frozen=True, eq=False)
class RestStiffnessSolver:
    """The linear body that a problem is at rest.

    Parameters
    ----------
    problem
        Whose stiffness is solved with.
    preconditioner
        Of the problem: for conjugate gradients, where no inverse is had.
    inner
        Most iterations of these.
    tolerance
        Relative residual of the linear solves.
    largest_factor
        Unknowns up to which the solves are worth a factor of their own on the CPU. Of 17,000 smoothed nodes it takes
        12 s, and a solve 10 ms instead of 295 by two levels.
    """

    problem: Problem
    preconditioner: Preconditioner
    inner: int
    tolerance: float = 1e-9
    largest_factor: int = 60_000

    @cached_property
    def exact(self) -> Preconditioner | None:
        """The inverse of the rest stiffness in the solver's own precision, where one is had or pays for many solves."""
        pays = not self.problem.device.on_cuda and self.problem.rows <= self.largest_factor
        return build_rest_solver(self.problem) if pays or is_exact(self.preconditioner) else None

    def answer(self, force: wp.array) -> wp.array:
        """Motions (3N, b) [m] that it answers forces (3N, b) [N] with; the forces are lost.

        Raises
        ------
        InputError
            Too few iterations.
        """
        problem, columns = self.problem, force.shape[1]
        if self.exact is not None:
            out = problem.device.zeros(*force.shape)
            self.exact.apply(force, np.ones(columns, bool), out)
            problem.constraint.project(out)
            return out
        problem.linearise(problem.device.zeros(*force.shape), np.zeros(columns, bool))
        self.preconditioner.prepare(problem, columns)
        wanted = self.tolerance * compute_norms(problem.device, force)
        found = solve_conjugate_gradients(problem, self.preconditioner, force, wanted, self.inner)
        if (compute_norms(problem.device, force) > 10.0 * wanted).any():
            raise InputError(
                f"a linear solve of the series did not reach {self.tolerance:g} in {self.inner} iterations: ask for an "
                "Accuracy of more `inner` ones."
            )
        return found.x
