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
"""Names of fields (B,) of a `Deformation` that some models do not compute."""
COLUMNS = ("bound", "reaction_bound", "stretch")
"""Names of fields (2, B) of a `Deformation` that some models do not compute."""


class Outcome(Enum):
    """Outcome of a load case; the value is the description for users."""

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
        """Return True if the result is reliable."""
        return self in (Outcome.CONVERGED, Outcome.CONVERGED_ANEW, Outcome.CONVERGED_IN_STEPS, Outcome.PREDICTED)


@dataclass(frozen=True)
class Cost:
    """Wall-clock time by stage for the whole batch [s], without set-up (factorisation, compilation)."""

    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def total(self) -> float:
        """Sum over the stages [s]."""
        return float(sum(self.seconds.values()))


@dataclass(frozen=True, eq=False)
class Deformation:
    """Results of one deformation model for B load cases.

    Parameters
    ----------
    displacement
        Displacements (B, n, 3) [m], always finite.
    nodes
        Mesh vertices (n,) of the rows (a surrogate may be limited to the tumour's).
    outcome
        Outcomes of the B load cases.
    iterations, residual, time
        Outer iterations of all descents, relative residual as in `Accuracy`, time [s], each (B,). A surrogate has 0
        iterations and NaN residual.
    reaction
        Force [N] and moment about the tool's point [N m] that each tool exerts: (B, tools, 6).
    memory
        History of tissue and tools, by term name, rows (B, ...); required by the next solution.
    warm
        Data that accelerate the next solution, rows (B, ...): optional, and neither stored nor compared.
    cost
        Computing time by stage.
    reached
        Fraction (B,) of the load or prescribed motion for which the displacement is in equilibrium to the
        tolerance: 1 if converged, otherwise the largest such fraction, 0 if the displacement is only the
        last accepted iterate, NaN if the model does not compute it.
    inverted
        Number (B,) of inverted or collapsed tetrahedra; -1 if the model does not compute it.
    leaked
        Volume (B,) that passes outwards through the closed skull, as a fraction of the volume exchanged through the
        craniotomy. NaN if the model does not compute it, such as live frames on a GPU or surrogates.
    bond
        Largest traction (B,) of a `Bonded` skull, as a fraction of the bond's strength. Above 1 the bond would fail,
        and the result is no longer valid. NaN without bond, or if the model does not compute it.
    bound
        Bounds (2, B) [m] on the error of all tumour vertices relative to the training reference, with probability 0.95
        and 0.99; NaN from a model without bounds.
    reaction_bound
        Bounds (2, B) [N] on the error of each tool force in `reaction`, with the same probabilities.
    stretch
        Smallest and largest principal stretch (2, B) of the tissue. NaN if the model does not compute it.
    strained
        Volume (B,) [m^3] with stretch outside the range measured on brain, 0.5 to 1.5. NaN as `stretch`.
    source
        Description of the model: elements and tissue of the FEM, or the estimator.
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
        """Return a subset (k,) of the load cases; the cost stays that of all."""
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
        """Return the result at some mesh vertices `nodes` (n,).

        Raises
        ------
        InputError
            A vertex that is not in `self.nodes`; values that are not integers.
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
    """Concatenate results for the same vertices; times are added, and only memories common to all are kept."""

    def stacked(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    def shared(name: str) -> dict[str, np.ndarray]:
        held = [getattr(part, name) for part in parts]
        return {key: np.concatenate([one[key] for one in held]) for key in sorted(set.intersection(*map(set, held)))}

    stages = parts[0].cost.seconds
    return Deformation(
        displacement=stacked("displacement"),
        nodes=parts[0].nodes,
        outcome=tuple(outcome for part in parts for outcome in part.outcome),
        iterations=stacked("iterations"),
        residual=stacked("residual"),
        time=stacked("time"),
        reaction=stacked("reaction"),
        memory=shared("memory"),
        warm=shared("warm"),
        cost=Cost({stage: sum(part.cost.seconds[stage] for part in parts) for stage in stages}),
        **{name: stacked(name) for name in ROWS},
        **{name: np.concatenate([getattr(part, name) for part in parts], axis=1) for name in COLUMNS},
        source=parts[0].source,
    )


def check_start(start: Deformation, count: int, vertex_count: int) -> None:
    """Reject a start that does not have `count` load cases at all vertices of the mesh.

    Raises
    ------
    InputError
        Another type; displacements of another shape; times or a memory with other rows, or not finite.
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
    """Return a start for a deformation model from user-defined displacements (B, V, 3) [m] of all vertices.

    Raises
    ------
    InputError
        Displacements of another shape, or not finite.
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
        """Anatomy that is deformed."""
        ...

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Compute the deformation under `loads`, from `start`, at mesh vertices `at` (n,); a pure function."""
        ...
