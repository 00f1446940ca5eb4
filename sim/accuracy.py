"""How exact an answer must be, and what it may cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .errors import InputError

Precision = Literal["float32", "float64"]
FLOOR: dict[str, float] = {"float32": 2e-5, "float64": 1e-11}
"""Smallest relative residual that each scalar type reaches reliably (round-off of the internal forces)."""


@dataclass(frozen=True)
class Accuracy:
    """Tolerance and budgets of a solve.

    Parameters
    ----------
    tolerance
        Converged: free gradient <= tolerance x the largest 2-norm among the terms' own gradients and the
        reaction at constrained nodes.
    outer
        Most Newton steps for one load. L-BFGS, which goes first unless they are very few, has a budget of its own.
    inner
        Most conjugate-gradient iterations in one Newton step.
    precision
        Scalar type of the solver.
    steps
        Most load steps that are tried when a load has no equilibrium within `outer`; zero gives up there.

    Raises
    ------
    InputError
        A tolerance below the floor of the scalar type, or budgets that allow no work.
    """

    tolerance: float = 1e-6
    outer: int = 200
    inner: int = 400
    precision: Precision = "float64"
    steps: int = 24

    def __post_init__(self) -> None:
        if self.precision not in FLOOR:
            raise InputError(f"no precision is called {self.precision!r}: choose one of {', '.join(FLOOR)}.")
        floor = FLOOR[self.precision]
        if not floor <= self.tolerance < 1.0:
            raise InputError(
                f"a tolerance of {self.tolerance:g} is outside [{floor:g}, 1): {self.precision} reaches {floor:g}; "
                "ask for that, or for float64."
            )
        if self.outer < 1 or self.inner < 1 or self.steps < 0:
            raise InputError(
                f"budgets of {self.outer} outer, {self.inner} inner and {self.steps} load steps allow no work: give at "
                "least 1, 1 and 0."
            )


DRAFT = Accuracy(tolerance=1e-2, outer=3, precision="float32", steps=0)
LIVE = Accuracy(tolerance=5e-3, outer=30, precision="float32", steps=8)
TRAIN = Accuracy(tolerance=1e-4, precision="float32")
REFERENCE = Accuracy(tolerance=1e-8)
