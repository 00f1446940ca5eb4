"""Accuracy and cost limits of a solve."""

from dataclasses import dataclass, replace
from numbers import Real
from typing import Literal

from .arguments import check_integer
from .errors import InputError

Precision = Literal["float32", "float64"]  # scalar types of a solver
MIN_TOLERANCE: dict[str, float] = {"float32": 2e-5, "float64": 1e-11}
"""Smallest relative residual that is reached reliably, by scalar type; round-off of the internal forces limits it."""


@dataclass(frozen=True)
class Accuracy:
    """Tolerance and iteration limits of a solve.

    Parameters
    ----------
    tolerance
        Relative tolerance. A solution has converged if |residual| <= tolerance x the largest of these 2-norms: the
        gradient of each energy term, and the reaction at constrained nodes.
    outer
        Maximum Newton steps for one load and for each of its load steps. The total is at most outer x (1 + steps).
    inner
        Maximum conjugate gradient iterations in one Newton step.
    precision
        Scalar type of the solver.
    steps
        Maximum load steps if a load does not converge within `outer`; 0 disables load stepping.
    evaluations
        Maximum force evaluations of the whole mesh before Newton's method starts; local solvers and L-BFGS share them.
        0: Newton's method only. None: a device-dependent default. With few `outer` steps only Newton's method is used.
    limit_strain
        True to report a converged solution as unreliable if a tetrahedron is inverted or strained beyond measured data.

    Raises
    ------
    InputError
        The tolerance is below `MIN_TOLERANCE`, or a limit is not an integer or is too small.
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
        """Maximum total number of Newton steps for one load, over all load steps and partial tool motions."""
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
"""Accuracy of a quick preview: at most three Newton steps, without load steps."""
LIVE = Accuracy(tolerance=4e-3, outer=30, precision="float32", steps=8)
"""Accuracy of frames that start from the solution of the previous frame: the default of scenes.

Maximum error of 60 such frames: 0.026 mm in palpation, and 0.019 mm under a spatula
(`python -m benchmarks live --frames 1000 --checked 60` on one H100, default tissue; `docs/notes/figures.md`).
"""
TRAIN = Accuracy(tolerance=1e-4, precision="float32")
"""Accuracy of training data sets: the default of `Fem`."""
NO_STRAIN_LIMIT = replace(TRAIN, limit_strain=False)
"""Accuracy as `TRAIN`, but without the strain limit, so that comparisons of solvers include overstrained tissue."""
REFERENCE = Accuracy(tolerance=1e-8)
"""Accuracy of reference solutions, in double precision; power series also require double precision."""
