"""Derivatives with respect to loads, by central differences of the forces that the loads cause at a fixed state."""

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..discretisation.term import Cases, StrainTerm
from ..errors import InputError
from ..loads import Displaced, Loads, Nodal, Prescribed, Resected, Retracted, Touching
from .tissue_gradient import STENCIL

ROTATION_STEP = 1e-6  # Step of rotations of a tool [rad].
# Relative to the radius. The force of a footprint is a sum over small triangles: its derivative by a step of 10 % is
# within 1 % of the derivative of the integral, by a step of 0.1 % only within 12 %.
FOOTPRINT_STEP = 0.1
# Steps of other arrays [1, m, m, m]; tools are moved by far less than the width of the gap, which may be 1 um.
STEPS = {"direction": 1e-5, "csf_level": 1e-6, "displacement": 1e-8, "pose": 1e-8}


def differentiate_loads(
    problem: Problem, space: Discretisation, cases: Cases, u: np.ndarray, adjoint: np.ndarray, unbalanced: np.ndarray
) -> tuple[dict[str, np.ndarray], ...]:
    """Return the derivatives with respect to each array of each cause, by name.

    Parameters
    ----------
    u, adjoint
        Equilibrium and adjoint solution (3N, b).
    unbalanced
        Seed minus stiffness times adjoint (3N, b): the derivative with respect to prescribed displacements.

    Raises
    ------
    InputError
        The loads contain a resection, or poses in single precision.
    """
    return tuple(
        dict(_differentiate_cause(problem, space, cases, number, u, adjoint, unbalanced))
        for number in range(len(cases.loads.causes))
    )


def _differentiate_cause(
    problem: Problem,
    space: Discretisation,
    cases: Cases,
    number: int,
    u: np.ndarray,
    adjoint: np.ndarray,
    unbalanced: np.ndarray,
) -> Iterator[tuple[str, np.ndarray]]:
    cause: Any = cases.loads.causes[number]
    by_node = adjoint.T.reshape(len(cases.loads), -1, 3)
    if isinstance(cause, Nodal):
        yield "force", by_node[:, : cause.force.shape[1]]
        return
    if isinstance(cause, Prescribed):
        held = problem.constraint.sum_by_value(unbalanced.T.reshape(by_node.shape))
        yield "displacement", space.sum_by_vertex(held)
        return
    if isinstance(cause, Displaced):
        force = problem.constraint.compute_footprint_force(problem.device.upload(unbalanced))
        assert force is not None
        yield "displacement", force.T
        return
    if isinstance(cause, Resected):
        raise InputError("a resection step has no derivative: differentiate before or after it.")
    if isinstance(cause, Touching | Retracted) and problem.device.precision != "float64":
        raise InputError("derivatives by the pose of a tool require float64: use an Accuracy of that precision.")
    state = problem.device.upload(u)

    def compute_work(array_name: str, change: np.ndarray) -> np.ndarray:
        """Return the work (b,) of the adjoint solution against all but elastic forces, for a changed array."""
        changed = replace(cause, **{array_name: change})
        causes = tuple(changed if k == number else one for k, one in enumerate(cases.loads.causes))
        moved = replace(cases, loads=Loads(causes, cases.loads.times))
        out = problem.device.allocate(*u.shape)
        for term in problem.terms:
            if not isinstance(term, StrainTerm):
                term.begin(moved)
                term.add_gradient(state, out)
        return np.einsum("nb,nb->b", adjoint, out.numpy().astype(np.float64))

    for field in fields(cause):
        array = getattr(cause, field.name)
        slopes = []
        for direction in _list_directions(array, field.name):
            turns = field.name == "pose" and direction[-1] >= 3
            step = ROTATION_STEP if turns else _choose_step(cause, field.name)
            parts = [
                weight * compute_work(field.name, _move(array, field.name, direction, offset * step))
                for offset, weight in STENCIL
            ]
            slopes.append(-np.sum(parts, axis=0) / step)
        yield field.name, _arrange(np.stack(slopes, axis=-1), array, field.name)
    for term in problem.terms:
        if not isinstance(term, StrainTerm):
            term.begin(cases)


def _choose_step(cause: Any, name: str) -> np.ndarray | float:
    """Return the step of an array, a number or (b,); an array in which forces are linear has a step of its own size."""
    if name in ("point", "footprint"):
        return FOOTPRINT_STEP * cause.footprint
    if name == "direction":
        return STEPS[name] * np.linalg.norm(cause.direction, axis=1)
    return STEPS.get(name) or float(np.abs(getattr(cause, name)).max(initial=0.0)) or 1.0


def _list_directions(array: np.ndarray, name: str) -> Iterator[tuple[int, ...]]:
    """Return the index of each component of a row; of a pose, tool number and component of translation and rotation."""
    shape = (*array.shape[1:-2], 6) if name == "pose" else array.shape[1:]
    return iter(np.ndindex(*shape))


def _move(array: np.ndarray, name: str, index: tuple[int, ...], step: Any) -> np.ndarray:
    """Return the array with one component of every row changed by `step`, a number or (b,)."""
    out = array.copy()
    if name != "pose":
        out[(slice(None), *index)] += step
        return out
    *tool, axis = index
    own = out[(slice(None), *tool)]
    if axis < 3:
        own[:, axis, 3] += step
    else:
        own[:, :3, :3] = Rotation.from_rotvec(step * np.eye(3)[axis - 3]).as_matrix() @ own[:, :3, :3]
    return out


def _arrange(slopes: np.ndarray, array: np.ndarray, name: str) -> np.ndarray:
    """Return the derivatives (b, n) in the shape of the array; of a pose, (b, ..., 6)."""
    return slopes.reshape((*array.shape[:-2], 6) if name == "pose" else array.shape)
