"""Accuracy and cost limits of a solve."""

from dataclasses import dataclass, replace
from numbers import Real
from typing import Literal

from .arguments import check_integer
from .errors import InputError

Precision = Literal["float32", "float64"]  # scalar types of a solver
MIN_TOLERANCE: dict[str, float] = {"float32": 2e-5, "float64": 1e-11}
"""Smallest relative residual that each scalar type reaches reliably (round-off of the internal forces)."""


@dataclass(frozen=True)
class Accuracy:
    """Tolerance and iteration limits of a solve.

    Parameters
    ----------
    tolerance
        Relative tolerance: converged if |residual| <= tolerance x the largest 2-norm among the gradients of the terms
        and the reaction at constrained nodes.
    outer
        Maximum Newton steps for one load, and for each of its load steps; in total at most outer x (1 + steps).
    inner
        Maximum conjugate gradient iterations in one Newton step.
    precision
        Scalar type of the solver.
    steps
        Maximum load steps if a load does not converge within `outer`; 0 disables load stepping.
    evaluations
        Maximum force evaluations of the whole body before Newton, shared by local solvers and L-BFGS; 0: Newton
        only. None: a device-dependent default. With few `outer` steps only Newton is used.
    limit_strain
        Report equilibria as not good if tetrahedra are inverted, or strained beyond the range measured on brain.

    Raises
    ------
    InputError
        A tolerance below the floor of the scalar type; limits that are not integers or too small.
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
        """Maximum Newton steps for one load, over all load steps and tool strides."""
        return self.outer * (1 + self.steps)

    def __post_init__(self) -> None:
        if self.precision not in tuple(MIN_TOLERANCE):  # tuple, since `precision` may be unhashable
            raise InputError(f"no precision is called {self.precision!r}: choose one of {', '.join(MIN_TOLERANCE)}.")
        floor = MIN_TOLERANCE[self.precision]
        if not isinstance(self.tolerance, Real):
            raise InputError(f"tolerance is {self.tolerance!r:.80}: give a number from {floor:g} to 1.")
        if not floor <= self.tolerance < 1.0:
            raise InputError(
                f"a tolerance of {self.tolerance:g} is outside [{floor:g}, 1): {self.precision} reaches {floor:g}; "
                "ask for that, or for float64."
            )
        for name, least in (("outer", 1), ("inner", 1), ("steps", 0)):
            check_integer(name, getattr(self, name), least)
        if self.evaluations is not None:
            check_integer("evaluations", self.evaluations, 0)


DRAFT = Accuracy(tolerance=1e-2, outer=3, precision="float32", steps=0)
"""For a quick preview: at most three Newton steps, and no load steps."""
LIVE = Accuracy(tolerance=4e-3, outer=30, precision="float32", steps=8)
"""For frames that start from the previous frame: the default of scenes.

Maximum error of 60 such frames: 0.026 mm in palpation, and 0.019 mm under a spatula
(`python -m benchmarks live --frames 1000 --checked 60` on one H100, default tissue; `docs/notes/figures.md`).
"""
TRAIN = Accuracy(tolerance=1e-4, precision="float32")
"""For training data sets: the default of `Fem`."""
NO_STRAIN_LIMIT = replace(TRAIN, limit_strain=False)
"""`TRAIN` for comparisons of solvers and models, which include equilibria of overstrained tissue."""
REFERENCE = Accuracy(tolerance=1e-8)
"""For reference solutions; in double precision, which power series require too."""
