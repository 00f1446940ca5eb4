"""What every learner of a data set is given: loads and answers, and what its finite elements give without learning."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..data.splits import Split
from ..evaluation.solve_counts import SolveCounts
from ..model.learned import Part
from ..regressors.force_series import TERMS
from .examples import Examples
from .expansion import ADDED, COARSE, EXPANDED, TOUCHED, Expansion


@dataclass(frozen=True, eq=False)
class SharedInputs:
    """What every learner of a data set is given, made when it is asked for.

    Answers to loads inside the discs left out are not among it, nor is the series tabulated there. How linear tissue
    gives is given at every node: a dent is no sum of dents elsewhere, and what lies under one follows it. The second
    order of the tumour follows from that and the law, so that it is given too.

    Parameters
    ----------
    basis_from
        The examples whose responses the series' bases span.
    expansion
        Of the same data.
    split
        What was left out, if anything.
    """

    basis_from: Examples
    expansion: Expansion
    split: Split | None = None

    @cached_property
    def series(self) -> tuple[Part, ...]:
        """What the finite elements' series adds to compliance, at the tumour and at the cortex, if there is more."""
        bases = self.expansion.bases(self.basis_from, ADDED, COARSE)
        found = self.expansion.on(bases, self._left_out(self.expansion.places))
        return tuple(Part("tool", part, basis) for part, basis in zip(found, bases, strict=True))

    def solve_counts(self, name: str, examples: Examples) -> SolveCounts:
        """The solves that a learner of `LEARNERS` or `OF_POSES` is given, a user's own too."""
        known, data, loads = self.expansion, self.expansion.data, len(examples.loads.point)
        units = series = inside = 0
        seconds = [data.seconds("load", loads)]
        of_tumour = name in ("linear", "residual", *EXPANDED)
        if data.tool is None and (len(known.cortex) or of_tumour):
            units = len(data.unit_good)
            inside = 3 * of_tumour * int(self._left_out(known.patch.points).sum())
            seconds.append(data.seconds("unit response", units))
        if name in TOUCHED:
            contact, _, took = known.contact
            units, inside = contact.points.size, 3 * int(self._left_out(contact.points).sum())
            seconds.append(took)
        if name in EXPANDED:
            places = int((~self._left_out(known.places)).sum())
            series = places * len(known.radii) * TERMS
            took = known.tabulated.seconds * places / len(known.places)
            seconds.append(took if np.isfinite(took) else None)
        total = None if None in seconds else float(sum(filter(None, seconds)))
        return SolveCounts(loads, units, series, inside, total)

    def _left_out(self, points: np.ndarray) -> np.ndarray:
        return np.zeros(len(points), bool) if self.split is None else self.split.covers(points)
