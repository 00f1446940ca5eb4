"""Derivatives with respect to loads, by central differences of the forces that the loads cause at a fixed state."""

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..discretisation.term import Cases, StrainTerm
from ..errors import InputError
from ..loads import BuiltIn, Displaced, Loads, Nodal, Prescribed, Resected, Retracted, Touching
from .tissue_gradient import STENCIL

ROTATION_STEP = 1e-6  # Step of rotations of a tool [rad].
OWN_STEP = 1e-4  # Relative step of the arrays of user-defined causes.
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
    for field in fields(cause):
        slopes = iterate_load_slopes(problem, cases, number, field.name, problem.device.upload(u))
        work = np.stack([-np.einsum("nb,nb->b", adjoint, slope) for slope in slopes], axis=-1)
        yield field.name, _arrange(work, getattr(cause, field.name), field.name)


def iterate_load_slopes(problem: Problem, cases: Cases, number: int, name: str, u: wp.array) -> Iterator[np.ndarray]:
    """Yield the derivative (3N, b) of the energy's gradient at u by each component of an array of cause `number`.

    Raises
    ------
    InputError
        The cause has no such array, acts as a constraint or on all nodes, or is a pose in single precision.
    """
    cause: Any = cases.loads.causes[number] if 0 <= number < len(cases.loads.causes) else None
    if cause is None or isinstance(cause, Nodal | Prescribed | Displaced | Resected) or not hasattr(cause, name):
        raise InputError(f"cause {number} has no array {name!r} for this derivative: see `compute_jacobian`.")
    if isinstance(cause, Touching | Retracted) and problem.device.precision != "float64":
        raise InputError("derivatives by the pose of a tool require float64: use an Accuracy of that precision.")
    array, terms = getattr(cause, name), [term for term in problem.terms if not isinstance(term, StrainTerm)]

    def compute_gradient(change: np.ndarray) -> np.ndarray:
        """Return the gradient of all but elastic terms for a changed array."""
        changed = replace(cause, **{name: change})
        causes = tuple(changed if k == number else one for k, one in enumerate(cases.loads.causes))
        moved, out = replace(cases, loads=Loads(causes, cases.loads.times)), problem.device.allocate(*u.shape)
        for term in terms:
            term.begin(moved)
            term.add_gradient(u, out)
        return out.numpy().astype(np.float64)

    for direction in _list_directions(array, name):
        step = ROTATION_STEP if name == "pose" and direction[-1] >= 3 else _choose_step(cause, name)
        parts = [weight * compute_gradient(_move(array, name, direction, offset * step)) for offset, weight in STENCIL]
        yield np.sum(parts, axis=0) / step
    for term in terms:
        term.begin(cases)


def _choose_step(cause: Any, name: str) -> np.ndarray | float:
    """Return the step of an array, a number or (b,); an array in which forces are linear has a step of its own size."""
    if name in ("point", "footprint"):
        return FOOTPRINT_STEP * cause.footprint
    if name == "direction":
        return STEPS[name] * np.linalg.norm(cause.direction, axis=1)
    size = float(np.abs(getattr(cause, name)).max(initial=0.0)) or 1.0
    return STEPS.get(name) or (size if isinstance(cause, BuiltIn) else OWN_STEP * size)


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
