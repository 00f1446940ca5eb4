"""How exact an answer must be, and what it may cost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Real
from typing import Literal

from .arguments import check_at_least
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
        Most Newton steps for one load, and for each of its load steps; all together at most outer x (1 + steps).
    inner
        Most conjugate-gradient iterations in one Newton step.
    precision
        Scalar type of the solver.
    steps
        Most load steps that are tried when a load has no equilibrium within `outer`; zero gives up there.
    evaluations
        Most evaluations of the whole body's forces before Newton, which local solvers and L-BFGS share; 0: Newton
        alone. None: as many as are worth it on the device. Few `outer` steps are Newton's alone, whatever this says.
    limit_strain
        Report equilibria with inverted tetrahedra, or strained beyond what was measured on brain, as not good.

    Raises
    ------
    InputError
        A tolerance below the floor of the scalar type, budgets that allow no work or are no whole numbers.
    """

    tolerance: float = 1e-6
    outer: int = 200
    inner: int = 400
    precision: Precision = "float64"
    steps: int = 24
    evaluations: int | None = None
    limit_strain: bool = True

    @property
    def most(self) -> int:
        """Most Newton steps for one load, all load steps and strides of tools together."""
        return self.outer * (1 + self.steps)

    def __post_init__(self) -> None:
        if self.precision not in tuple(FLOOR):  # which need not be hashable
            raise InputError(f"no precision is called {self.precision!r}: choose one of {', '.join(FLOOR)}.")
        floor = FLOOR[self.precision]
        if not isinstance(self.tolerance, Real):
            raise InputError(f"tolerance is {self.tolerance!r:.80}: give a number from {floor:g} to 1.")
        if not floor <= self.tolerance < 1.0:
            raise InputError(
                f"a tolerance of {self.tolerance:g} is outside [{floor:g}, 1): {self.precision} reaches {floor:g}; "
                "ask for that, or for float64."
            )
        for name, least in (("outer", 1), ("inner", 1), ("steps", 0)):
            check_at_least(name, getattr(self, name), least)
        if self.evaluations is not None:
            check_at_least("evaluations", self.evaluations, 0)


DRAFT = Accuracy(tolerance=1e-2, outer=3, precision="float32", steps=0)
"""For a first look: three Newton steps at most, and no load steps for what does not converge."""
LIVE = Accuracy(tolerance=4e-3, outer=30, precision="float32", steps=8)
"""For frames that start from the one before: the default of scenes.

Of 60 such frames the worst was 0.026 mm off while palpating, and 0.019 mm under a spatula
(`python -m benchmarks live --frames 1000 --checked 60` on one H100, default tissue; `docs/notes/figures.md`).
"""
TRAIN = Accuracy(tolerance=1e-4, precision="float32")
"""For data sets that models learn from: the default of `Fem`."""
STRAINED = replace(TRAIN, limit_strain=False)
"""`TRAIN` for comparisons of solvers and models, in which equilibria of strained tissue count."""
REFERENCE = Accuracy(tolerance=1e-8)
"""For comparisons, as the truth that others are held against; in double precision, which power series need too."""
