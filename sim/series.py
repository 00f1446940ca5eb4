"""The answer as a power series in the size of the load, about rest.

Cochelin 1994, "A path-following technique via an asymptotic-numerical method", Comput. Struct. 53:1181-1192: every
order is one linear solve with the stiffness at rest, its right side what the lower orders leave unbalanced. That is had
here from the forces themselves, by central differences, so that any law and element will do.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from .columns import combined
from .problem import Problem

# The largest displacement in a difference, in edges: its square is the error, its fourth power must stand out of the
# round-off.
STEP = 0.01


def taylor(
    problem: Problem, at_rest: Callable[[wp.array], wp.array], columns: int, edge: float, orders: int
) -> list[wp.array]:
    """Coefficients u_1 ... u_n, (3N, b) [m] each: under s times the loads, u(s) = s u_1 + s^2 u_2 + ... + s^n u_n.

    Parameters
    ----------
    problem
        In float64, begun with `columns` loads whose forces are in proportion to them and do not follow the motion.
    at_rest
        From forces (3N, b) [N] to the motions (3N, b) [m] that the stiffness at rest answers with.
    edge
        Length of an element's edges [m].
    """
    device = problem.device
    rest = device.zeros(problem.rows, columns)

    def free_gradient(u: wp.array) -> wp.array:
        gradient = problem.gradient(u)
        problem.constraint.project(gradient)
        return gradient

    def answer(factor: np.ndarray | float, force: wp.array) -> wp.array:
        return at_rest(combined(device, rest, factor, force, device.zeros(problem.rows, columns)))

    def polynomial(size: np.ndarray) -> wp.array:
        total = device.zeros(problem.rows, columns)
        for order, term in enumerate(found, start=1):
            combined(device, total, size**order, term, total)
        return total

    load = free_gradient(rest)
    found = [answer(-1.0, load)]
    largest = np.abs(found[0].numpy()).max(axis=0)
    step = STEP * edge / np.where(largest > 0.0, largest, 1.0)
    for order in range(2, orders + 1):
        up, down = (free_gradient(polynomial(sign * step)) for sign in (1.0, -1.0))
        even = order % 2 == 0
        left = combined(device, up, 1.0 if even else -1.0, down, up)
        combined(device, left, -2.0 if even else 2.0 * step, load, left)
        found.append(answer(-0.5 / step**order, left))
    return found
