"""What each deformer has cost and missed so far on a page: accuracy against time, live."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surrogate.evaluation.choose import unbeaten

# Loads that are kept of each deformer, the last ones.
RECENT = 120


@dataclass(frozen=True)
class Row:
    """A deformer's medians over `loads` loads; `best` where no other equals or beats it in both. None: no ranking."""

    name: str
    milliseconds: float
    millimetres: float
    loads: int
    best: bool | None


class Tally:
    """Milliseconds and mean distance from the finite elements, by deformer and load."""

    def __init__(self) -> None:
        self._took: dict[str, dict[str, float]] = {}
        self._missed: dict[str, dict[str, float]] = {}

    def took(self, name: str, load: str, seconds: float) -> None:
        """A deformer answered a load, named by its stamp."""
        _keep(self._took.setdefault(name, {}), load, 1e3 * seconds)

    def missed(self, name: str, load: str, metres: float) -> None:
        """The finite elements, solved to the end, say how far off a deformer was under a load."""
        _keep(self._missed.setdefault(name, {}), load, 1e3 * metres)

    @property
    def rows(self) -> list[Row]:
        """The deformers of which both are known, fastest first.

        Where all of them were shown some of the same loads, those alone count, and the rows are ranked. Otherwise each
        counts its own, and there is no ranking: a median over other loads is no comparison.
        """
        known = {name: self._took.get(name, {}).keys() & missed.keys() for name, missed in self._missed.items()}
        known = {name: loads for name, loads in known.items() if loads}
        common = set.intersection(*map(set, known.values())) if len(known) > 1 else set()
        places = {name: self._place(name, common or loads) for name, loads in known.items()}
        best = unbeaten(places) if common else None
        return [
            Row(name, *place, len(common or known[name]), None if best is None else name in best)
            for name, place in sorted(places.items(), key=lambda item: item[1])
        ]

    def _place(self, name: str, loads: set[str]) -> tuple[float, float]:
        took, missed = self._took[name], self._missed[name]
        return float(np.median([took[load] for load in loads])), float(np.median([missed[load] for load in loads]))


def _keep(numbers: dict[str, float], load: str, value: float) -> None:
    """Note the newest value of a load, and forget the load that was noted longest ago."""
    numbers.pop(load, None)
    numbers[load] = value
    if len(numbers) > RECENT:
        del numbers[next(iter(numbers))]
