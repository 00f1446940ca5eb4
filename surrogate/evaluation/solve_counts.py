"""How many finite-element solves a learner is given, and what they took."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SolveCounts:
    """Solves by kind, and their wall time.

    Parameters
    ----------
    loads
        Nonlinear solves: the training loads.
    units
        Linear solves of unit forces at nodes of the cortex.
    series
        Linear solves of the power series: places x radii x terms.
    inside
        Those of them inside the discs left out that are of the tumour.
    seconds
        Of all these solves, on the machine that made them; None where the data do not state it, and where a stopped run
        went on.
    """

    loads: int
    units: int
    series: int
    inside: int
    seconds: float | None

    @property
    def total(self) -> int:
        """All of them."""
        return self.loads + self.units + self.series
