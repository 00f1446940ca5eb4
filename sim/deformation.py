"""What comes out of every deformer: displacements, how they came about, and what they cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Protocol, runtime_checkable

import numpy as np

from .anatomy import Anatomy
from .arguments import as_array, check_numbers_array, check_whole_numbers, is_all_finite
from .errors import InputError
from .loads import Loads

ROWS = ("reached", "inverted", "leaked", "bond", "strained")
"""Fields (B,) of a `Deformation` that not every deformer knows."""
COLUMNS = ("bound", "reaction_bound", "stretch")
"""Fields (2, B) of a `Deformation` that not every deformer knows."""


class Outcome(Enum):
    """How an answer came about; the value is the sentence that a user reads."""

    CONVERGED = "converged to the tolerance asked for"
    CONVERGED_ANEW = "converged to the tolerance asked for, from rest: the start lay inside out, led there, or nowhere"
    CONVERGED_IN_STEPS = "converged to the tolerance asked for, the load applied in steps"
    BUDGET = "stopped when the budget of steps was spent"
    STALLED = "stopped because no step lowered the energy"
    ROUND_OFF = (
        "stopped because the residual is at the round-off of its number type; float64 or a coarser tolerance goes on"
    )
    PIERCED = "stopped because a tool came to be inside the tissue, where it has no surface to press on"
    ON_BONE = "a tool overlaps surface that is fixed or covered by the skull: it stands on bone"
    INVERTED = "in equilibrium, but tetrahedra are inverted, as in no tissue: the load is too strong for this mesh"
    OVERSTRAINED = "in equilibrium, but more than 1 ml is strained beyond what was measured on brain"
    NOT_FINITE = "stopped because a number overflowed"
    GUESSED = "a first guess: nothing was solved"
    PREDICTED = "predicted by a trained model inside its training range"
    EXTRAPOLATED = "predicted by a trained model outside its training range: do not rely on it"

    @property
    def good(self) -> bool:
        """Whether the answer may be relied on."""
        return self in (
            Outcome.CONVERGED,
            Outcome.CONVERGED_ANEW,
            Outcome.CONVERGED_IN_STEPS,
            Outcome.PREDICTED,
        )


@dataclass(frozen=True)
class Cost:
    """Wall seconds by stage, for the whole batch; set-up (factorisation, compilation) is not among them."""

    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def total(self) -> float:
        """Sum over the stages [s]."""
        return float(sum(self.seconds.values()))


@dataclass(frozen=True, eq=False)
class Deformation:
    """B answers of one deformer.

    Parameters
    ----------
    displacement
        (B, n, 3) [m], always finite.
    nodes
        (n,) the mesh vertices that the rows belong to (a surrogate may know only the tumour's).
    outcome
        B outcomes.
    iterations, residual, time
        (B,): outer steps of all descents, relative residual as in `Accuracy`, time [s]. A surrogate has zero
        iterations, and NaN for the residual that it did not compute.
    reaction
        (B, tools, 6): force [N] and moment about the tool's point [N m] that each tool exerts.
    memory
        What the tissue and the tools remember: by the name of a term, rows (B, ...). The next answer needs it.
    warm
        What makes the next answer faster, rows (B, ...): it may be dropped, and is neither stored nor compared.
    cost
        Seconds by stage.
    reached
        (B,): the share of the load, or of the prescribed motion, under which the displacement is in equilibrium to the
        tolerance. 1 when converged; of a case that failed, the largest share found, and 0 where the displacement is
        merely the last accepted state. NaN from a deformer that does not know.
    inverted
        (B,) whole numbers: tetrahedra that lie inside out, or collapsed; -1 from a deformer that does not know.
    leaked
        (B,): the volume that passes out through the closed skull, as a share of what the opening takes in and gives
        out. NaN from a deformer that does not know, as a live frame on a card or a trained model.
    bond
        (B,): the largest traction of a `Bonded` skull, as a share of what the bond bears. Above 1 the bond would tear,
        and the answer is no longer one of its law. NaN where nothing is bonded, or from a deformer as above.
    bound
        (2, B) [m]: with probability 0.95, and 0.99, no tumour vertex is farther off what the deformer was trained on;
        NaN from one that promises nothing.
    reaction_bound
        (2, B) [N]: the same of the force of each tool in `reaction`.
    stretch
        (2, B): the smallest and the largest principal stretch of the tissue. NaN from a deformer that does not know.
    strained
        (B,) [m^3]: the volume whose stretch leaves the range measured on brain, 0.5 to 1.5. NaN as `stretch`.
    source
        Who answered, in words: finite elements of which kind and tissue, or what learned from them.
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
            raise AssertionError("a deformer let a displacement pass that is not finite: a defect of the deformer")

    def __len__(self) -> int:
        return len(self.displacement)

    def rows(self, index: np.ndarray) -> Deformation:
        """Return some of the answers (k,), as a deformation; the cost stays that of all."""
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

    def at(self, nodes: np.ndarray) -> Deformation:
        """Return the rows of some mesh vertices `nodes` (n,).

        Raises
        ------
        InputError
            A vertex that is not among `self.nodes`; what are no whole numbers.
        """
        nodes = check_whole_numbers("the vertices", nodes)
        if np.array_equal(nodes, self.nodes):
            return self
        missing = ~np.isin(nodes, self.nodes)
        if missing.any():
            raise InputError(
                f"this deformation does not know vertex {nodes[missing][0]}: ask for one of its {len(self.nodes)} "
                "vertices."
            )
        order = np.argsort(self.nodes)
        position = order[np.searchsorted(self.nodes, nodes, sorter=order)]
        return replace(self, displacement=self.displacement[:, position], nodes=nodes)


def join_deformations(parts: Sequence[Deformation]) -> Deformation:
    """Answers of the same vertices, one part after the other; seconds add up, and of memories stays what all have."""

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


def check_start(start: Deformation, count: int, vertices: int) -> None:
    """Refuse a start that is not one of `count` load cases at all vertices of the mesh.

    Raises
    ------
    InputError
        What is no deformation; displacements of another shape; times or a memory of other rows, or not finite.
    """
    if not isinstance(start, Deformation):
        raise InputError(f"the start is a {type(start).__name__}: give a Deformation, or none.")
    if np.shape(start.displacement) != (count, vertices, 3):
        raise InputError(
            f"the start has displacements of shape {np.shape(start.displacement)}: give every vertex of {count} load "
            f"cases, ({count}, {vertices}, 3)."
        )
    # A term may be called as something warm is: each is checked as what it is.
    needed = [(name, values, True) for name, values in {"time": start.time, **start.memory}.items()]
    for name, values, finite in [*needed, *((name, values, False) for name, values in start.warm.items())]:
        array = as_array(f"the start's {name!r}", values)
        good = array.dtype.kind in "fiu" and array.shape[:1] == (count,)
        if not good or (finite and not is_all_finite(array)):
            raise InputError(
                f"the start's {name!r} are no {count} rows of finite numbers: start from an answer to {count} loads as "
                "it came, or from rest."
            )


def guess(displacement: np.ndarray) -> Deformation:
    """Return a start for a deformer: displacements (B, V, 3) [m] of every vertex that somebody has thought of.

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
    """Whatever answers loads with a deformation: the finite elements, or a model that learnt from them."""

    @property
    def anatomy(self) -> Anatomy:
        """The body that is deformed."""
        ...

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Answer `loads`, from `start`, at mesh vertices `at` (n,). Pure: same loads and start, same answer."""
        ...
