"""Total Lagrangian explicit dynamics (TLED), damped to the static equilibrium.

Miller, Joldes, Lance, Wittek 2007, Commun. Numer. Meth. Engng 23:121-134: undeformed shape gradients, lumped mass,
central differences. Joldes, Wittek, Miller 2011, Int. J. Numer. Meth. Biomed. Engng 27:173-185: mass scaling, and
damping by the lowest eigenvalue in the motion.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Elasticity
from ..runtime.views import run_in_order, to_host, to_library, to_view
from .models import Relaxation


@dataclass(frozen=True)
class ExplicitSteps:
    """Number and size of the time steps.

    Parameters
    ----------
    max_steps, check_interval
        Maximum number of steps, and number of steps between two convergence tests.
    step_fraction
        Time step as a fraction of the critical step in the undeformed state; below 1, as compressed tissue is stiffer.
    min_eigenvalue
        Initial estimate of the lowest eigenvalue, relative to the highest eigenvalue.
    """

    max_steps: int = 4000
    check_interval: int = 25
    step_fraction: float = 0.7
    min_eigenvalue: float = 1e-3


TOLERANCE = 1e-3  # Relative residual of convergence.


def build_solver(
    problem: Problem, space: Discretisation, tissue: Elasticity, settings: ExplicitSteps = ExplicitSteps()
) -> Callable[[int], tuple[wp.array, int]]:
    """Return a solver: a function of the number b of load cases that returns displacements (3N, b) [m] and steps.

    Masses are row sums of the undeformed stiffness, so that no eigenvalue of M^-1 K exceeds 1 (Gershgorin).
    """
    device = problem.device
    rows = np.asarray(abs(problem.rest_curvature()).sum(axis=1)).reshape(-1, 1)
    mass = to_library(device, np.where(rows > 0.0, rows, 1.0))  # a vertex without tetrahedron is fixed
    step = 2.0 * settings.step_fraction

    def relax(count: int) -> tuple[wp.array, int]:
        u, before, last = (device.allocate(problem.rows, count) for _ in range(3))
        x, old, place = to_view(u), to_view(before), to_view(last)
        force, lowest = 0.0 * place, np.full(count, settings.min_eigenvalue)
        for done in range(1, settings.max_steps + 1):
            gradient = problem.gradient(u)
            problem.constraint.project(gradient)
            damping = to_library(device, 2.0 * np.sqrt(lowest) * step)
            with run_in_order(device):
                g = to_view(gradient)
                if done % settings.check_interval == 0:
                    moved = x - place
                    change, motion = (to_host((moved * other).sum(0)) for other in (g - force, mass * moved))
                    known = (change > 0.0) & (change < motion)
                    lowest = np.where(known, change / np.where(known, motion, 1.0), lowest)
                    place[:], force = x, g
                new = x + ((2.0 - damping) * (x - old) - 2.0 * step**2 * g / mass) / (2.0 + damping)
                old[:], x[:] = x, new
            if done % settings.check_interval == 0:
                _, free, scale = problem.residual(u)
                if not (np.isfinite(free + scale) & (free > TOLERANCE * scale)).any():
                    return u, done
        return u, settings.max_steps

    return relax


EXPLICIT = Relaxation("smoothed", build_solver, TOLERANCE)
