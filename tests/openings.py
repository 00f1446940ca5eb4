"""A box with an opening on top, held below and sliding round it: what is far from the opening is nearly linear."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import pytest
from boxes import box, hold, surface_nodes
from oracle import tissue

from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.space import Discretisation, discretise
from sim.discretisation.term import Cases
from sim.effects import Effect, Elasticity, Held, NodalForce, Slide
from sim.linalg.pcg import Preconditioner
from sim.linalg.preconditioner import build_rest_solver
from sim.loads import Loads, Nodal
from sim.minimisers.lbfgs import Lbfgs
from sim.minimisers.lbfgs_kernels import DONE
from sim.runtime.device import find_device

MESH = box((8, 8, 5), 0.08, distortion=0.1)
TOP = MESH.nodes[:, 2] > MESH.nodes[:, 2].max() - 1e-9
OPENING = TOP & (np.abs(MESH.nodes[:, :2] - 0.04).max(axis=1) < 0.021)
TOTAL = np.array([[0.0, 0.0, -0.05], [0.1, 0.05, -0.3], [0.0, 0.0, 0.3], [-0.2, 0.1, -0.8], [0.0, 0.0, 0.0]])
EFFECTS: tuple[Effect, ...] = (Held(), Slide(), NodalForce())
FINE = 1e-8
LAWS_AND_ELEMENTS = pytest.mark.parametrize(
    ("law", "element"),
    [("linear", "p1"), ("neo-hookean", "p1"), ("stable-neo-hookean", "p1"), ("ogden", "p1"),
     ("stable-neo-hookean", "smoothed"), ("stable-neo-hookean", "p2")],
)  # fmt: skip
Descent = TypeVar("Descent")


def body(element: str = "p1") -> tuple[Anatomy, Discretisation]:
    """Held below, sliding on the sides and round an opening on top."""
    normal = np.where(TOP[:, None] & ~OPENING[:, None], [0.0, 0.0, 1.0], 0.0)
    for axis, side in ((0, 0.0), (0, 0.08), (1, 0.0), (1, 0.08)):
        wall = (np.abs(MESH.nodes[:, axis] - side) < 1e-9) & ~TOP
        normal[wall] = np.eye(3)[axis]
    anatomy = hold(MESH, surface_nodes(MESH) & (MESH.nodes[:, 2] < 1e-9), normal)
    return anatomy, discretise(MESH, element)


def loads_of(total: np.ndarray) -> Loads:
    force = np.zeros((len(total), len(MESH.nodes), 3))
    force[:, OPENING] = total[:, None] / OPENING.sum()
    return Loads((Nodal(force),))


def begun(law: str, element: str = "p1", total: np.ndarray = TOTAL) -> tuple[Problem, Discretisation]:
    anatomy, space = body(element)
    problem = compile_problem((Elasticity(tissue(law)), *EFFECTS), anatomy, find_device("cpu", "float64"), space)
    problem.begin(Cases(loads_of(total), np.zeros(len(total))))
    return problem, space


def descent_of(
    make: Callable[[Problem, Preconditioner, tuple[Effect, ...], Discretisation], Descent | None],
    problem: Problem,
    space: Discretisation,
    law: str,
) -> Descent:
    """What `make` makes of a problem that is `begun`."""
    found = make(problem, build_rest_solver(problem), (Elasticity(tissue(law)), *EFFECTS), space)
    assert found is not None
    return found


def equilibria(problem: Problem, total: np.ndarray = TOTAL) -> np.ndarray:
    """By L-BFGS on the whole."""
    problem.begin(Cases(loads_of(total), np.zeros(len(total))))
    start = problem.device.allocate(problem.rows, len(total))
    found = Lbfgs(problem, build_rest_solver(problem)).descend(start, np.full(len(total), FINE), 2000)
    assert (found.status == DONE).all()
    return found.u.numpy().copy()
