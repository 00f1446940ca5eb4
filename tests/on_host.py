"""The iteration's arrays are the device's; tests look at NumPy's."""

from dataclasses import dataclass, fields

import numpy as np

from sim.accuracy import Accuracy
from sim.discretisation.problem import Problem
from sim.minimisers.newton import Equilibrium, find_equilibrium
from sim.minimisers.newton_cg import DescentMethod


@dataclass(frozen=True, eq=False)
class Found:
    """An `Equilibrium` with u (3N, B) on the host."""

    u: np.ndarray
    outcome: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray
    linear_iterations: int


def equilibrium_of(problem: Problem, descent: DescentMethod, start: np.ndarray, accuracy: Accuracy) -> Found:
    """`find_equilibrium` from a start (3N, B) on the host."""
    found = find_equilibrium(problem, descent, problem.device.upload(start), accuracy)
    rest = {item.name: getattr(found, item.name) for item in fields(Equilibrium) if item.name != "u"}
    return Found(found.u.numpy(), **rest)
