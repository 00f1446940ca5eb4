"""Result of a deformation model: displacements, outcomes and cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Protocol, runtime_checkable

import numpy as np

from .anatomy import Anatomy
from .arguments import as_array, check_integers, check_numbers_array, is_all_finite
from .errors import InputError
from .loads import Loads

ROWS = ("reached", "inverted", "leaked", "bond", "strained")
"""Names of the `Deformation` fields of shape (B,) that some models do not compute."""
COLUMNS = ("bound", "reaction_bound", "stretch")
"""Names of the `Deformation` fields of shape (2, B) that some models do not compute."""


class Outcome(Enum):
    """Outcome of a load case; the value of each member is its description for users."""

    CONVERGED = "converged to the requested tolerance"
    CONVERGED_ANEW = "converged to the requested tolerance from the undeformed state, because the start failed"
    CONVERGED_IN_STEPS = "converged to the requested tolerance, with the load applied in steps"
    BUDGET = "not converged: the maximum number of steps is reached"
    STALLED = "not converged: no step lowers the energy"
    ROUND_OFF = "not converged: the residual is at the round-off of its number type; use float64 or a larger tolerance"
    PIERCED = "not converged: a tool penetrates the tissue"
    ON_BONE = "a tool overlaps bone: surface that is fixed or covered by the skull"
    INVERTED = "in equilibrium, but tetrahedra are inverted: the load is too strong for this mesh"
    OVERSTRAINED = "in equilibrium, but more than 1 ml is strained beyond the range measured on brain"
    NOT_FINITE = "not converged: numerical overflow"
    GUESSED = "no equilibrium equations were solved: approximation"
    PREDICTED = "predicted by a trained model inside its training range"
    EXTRAPOLATED = "predicted by a trained model outside its training range: do not rely on it"

    @property
    def good(self) -> bool:
        """True if a result with this outcome is reliable."""
        return self in (Outcome.CONVERGED, Outcome.CONVERGED_ANEW, Outcome.CONVERGED_IN_STEPS, Outcome.PREDICTED)


@dataclass(frozen=True)
class Cost:
    """Wall-clock time [s] by solver stage for the whole batch, without set-up such as factorisation or compilation."""

    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def total(self) -> float:
        """Total time [s] of all solver stages."""
        return float(sum(self.seconds.values()))


@dataclass(frozen=True, eq=False)
class Deformation:
    """Results of one deformation model for B load cases.

    Parameters
    ----------
    displacement
        Displacements (B, n, 3) [m], always finite.
    nodes
        Numbers (n,) of the mesh vertices in `displacement`; a surrogate may return only the vertices of the tumour.
    outcome
        Outcomes of the B load cases.
    iterations, residual, time
        Total outer iterations, relative residual as in `Accuracy`, and time [s] of the solution, each (B,). Surrogates
        report 0 iterations and a residual of NaN.
    reaction
        Force [N] and moment [N m] of each tool on the tissue, (B, tools, 6). Moments refer to the tool's point.
    memory
        History variables (B, ...) of each history-dependent term, by term name. The next solution requires this data.
    warm
        Optional arrays (B, ...) that accelerate the next solution. This data is neither stored in files nor compared.
    cost
        Computing time by stage.
    reached
        Fraction (B,) of the load or prescribed motion for which `displacement` is in equilibrium within the tolerance.
        1 if the solver has converged, otherwise the largest such fraction; 0 if `displacement` is only the last
        accepted iterate. NaN if the model does not compute this fraction.
    inverted
        Number (B,) of inverted or collapsed tetrahedra; -1 if the model does not compute this number.
    leaked
        Tissue volume (B,) that passes outwards through the closed skull, divided by the volume exchanged through the
        craniotomy. NaN if the model does not compute this fraction, as in live frames on a GPU or in surrogates.
    bond
        Largest traction (B,) on a `Bonded` skull, divided by the strength of the bond. Above 1 the bond would fail,
        and the result is not valid. NaN without a bond, or if the model does not compute this fraction.
    bound
        Bounds (2, B) [m] on the error of all tumour vertices relative to the training reference, with probability 0.95
        and 0.99. NaN if the model has no bounds.
    reaction_bound
        Bounds (2, B) [N] on the error of every tool force in `reaction`, with probability 0.95 and 0.99.
    stretch
        Smallest and largest principal stretch (2, B) of the tissue. NaN if the model does not compute the stretch.
    strained
        Tissue volume (B,) [m^3] with stretch outside 0.5 to 1.5, the range measured on brain. NaN if `stretch` is NaN.
    source
        Description of the model: elements and tissue of the FEM, or the estimator of a surrogate.
    """

    displacement: np.ndarray
    nodes: np.ndarray
    outcome: tuple[Outcome, ...]
    iterations: np.ndarray
    residual: np.ndarray
    time: np.ndarray
    reaction: np.ndarray
    memory: Mapping[str, Any] = field(default_factory=dict)
    warm: Mapping[str, Any] = field(default_factory=dict)
    cost: Cost = Cost()
    reached: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    inverted: np.ndarray = field(default_factory=lambda: np.array(-1))
    leaked: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    bond: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    bound: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    reaction_bound: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    stretch: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    strained: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    source: str = ""

    def __post_init__(self) -> None:
        count = len(self.displacement)
        for name, shape in [*((name, (count,)) for name in ROWS), *((name, (2, count)) for name in COLUMNS)]:
            given = getattr(self, name)
            if given.shape != shape:
                object.__setattr__(self, name, np.broadcast_to(given, shape))
        if not is_all_finite(self.displacement):
            raise AssertionError("a deformation model returned non-finite displacements: this is a defect of the model")

    def __len__(self) -> int:
        return len(self.displacement)

    def select(self, index: np.ndarray) -> Deformation:
        """Return the results of the load cases `index` (k,); `cost` remains the cost of all load cases."""
        return replace(
            self,
            displacement=self.displacement[index],
            outcome=tuple(self.outcome[row] for row in index),
            iterations=self.iterations[index],
            residual=self.residual[index],
            time=self.time[index],
            reaction=self.reaction[index],
            **{name: getattr(self, name)[index] for name in ROWS},
            **{name: getattr(self, name)[:, index] for name in COLUMNS},
            memory={name: value[index] for name, value in self.memory.items()},
            warm={name: value[index] for name, value in self.warm.items()},
        )

    def restrict(self, nodes: np.ndarray) -> Deformation:
        """Return the result restricted to the mesh vertices `nodes` (n,).

        Raises
        ------
        InputError
            `nodes` contains a vertex that is not in `self.nodes`, or a value that is not an integer.
        """
        nodes = check_integers("the vertices", nodes)
        if np.array_equal(nodes, self.nodes):
            return self
        missing = ~np.isin(nodes, self.nodes)
        if missing.any():
            raise InputError(
                f"this deformation lacks vertex {nodes[missing][0]}: choose from its {len(self.nodes)} vertices."
            )
        order = np.argsort(self.nodes)
        position = order[np.searchsorted(self.nodes, nodes, sorter=order)]
        return replace(self, displacement=self.displacement[:, position], nodes=nodes)

    rows, at = select, restrict  # Former names, for one release.


def join_deformations(parts: Sequence[Deformation]) -> Deformation:
    """Concatenate results at the same vertices; costs are added, and only history variables common to all are kept."""

    def stack_arrays(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    def stack_common(name: str) -> dict[str, np.ndarray]:
        held = [getattr(part, name) for part in parts]
        return {key: np.concatenate([one[key] for one in held]) for key in sorted(set.intersection(*map(set, held)))}

    stages = parts[0].cost.seconds
    return Deformation(
        displacement=stack_arrays("displacement"),
        nodes=parts[0].nodes,
        outcome=tuple(outcome for part in parts for outcome in part.outcome),
        iterations=stack_arrays("iterations"),
        residual=stack_arrays("residual"),
        time=stack_arrays("time"),
        reaction=stack_arrays("reaction"),
        memory=stack_common("memory"),
        warm=stack_common("warm"),
        cost=Cost({stage: sum(part.cost.seconds[stage] for part in parts) for stage in stages}),
        **{name: stack_arrays(name) for name in ROWS},
        **{name: np.concatenate([getattr(part, name) for part in parts], axis=1) for name in COLUMNS},
        source=parts[0].source,
    )


def check_start(start: Deformation, count: int, vertex_count: int) -> None:
    """Reject an initial `start` without `count` load cases at all `vertex_count` mesh vertices.

    Raises
    ------
    InputError
        `start` is of another type, an array has another shape, or a time or a history variable is not finite.
    """
    if not isinstance(start, Deformation):
        raise InputError(f"the start is a {type(start).__name__}: give a Deformation, or none.")
    if np.shape(start.displacement) != (count, vertex_count, 3):
        raise InputError(
            f"the start has displacements of shape {np.shape(start.displacement)}: give every vertex of {count} load "
            f"cases, ({count}, {vertex_count}, 3)."
        )
    # A term and a warm-start entry may share a name: each is checked by its own rule.
    needed = [(name, values, True) for name, values in {"time": start.time, **start.memory}.items()]
    for name, values, finite in [*needed, *((name, values, False) for name, values in start.warm.items())]:
        array = as_array(f"the start's {name!r}", values)
        good = array.dtype.kind in "fiu" and array.shape[:1] == (count,)
        if not good or (finite and not is_all_finite(array)):
            raise InputError(
                f"the start's {name!r} are no {count} rows of finite numbers: use a solution of {count} loads "
                "unmodified, or no start."
            )


def build_start(displacement: np.ndarray) -> Deformation:
    """Return initial values for `Deformer.deform` from displacements (B, V, 3) [m] of all vertices, given by the user.

    Raises
    ------
    InputError
        The displacements have another shape or are not finite.
    """
    displacement = check_numbers_array("a guessed displacement", displacement)
    if displacement.ndim != 3 or displacement.shape[2] != 3:
        raise InputError(f"a guessed displacement has shape {displacement.shape}: give (B, V, 3) [m].")
    count, vertices, _ = displacement.shape
    unknown, none = np.full(count, np.nan), np.zeros(count)
    every, outcomes = np.arange(vertices), (Outcome.GUESSED,) * count
    return Deformation(displacement, every, outcomes, none.astype(int), unknown, none, np.zeros((count, 0, 6)))


@runtime_checkable
class Deformer(Protocol):
    """Interface of deformation models: FEM solvers and surrogates trained on them."""

    @property
    def anatomy(self) -> Anatomy:
        """Undeformed anatomy of the model."""
        ...

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Return the deformation under `loads` at mesh vertices `at` (n,), starting from `start`. No side effects."""
        ...
