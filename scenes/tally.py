"""What each deformer has cost and missed so far on a page: accuracy against time, live."""

from __future__ import annotations

from collections import deque

import numpy as np

from .pareto import unbeaten

# Frames that a median is taken of.
RECENT = 120


class Tally:
    """Medians, by deformer, of the last frames' milliseconds and of their mean distances from the finite elements."""

    def __init__(self) -> None:
        self._milliseconds: dict[str, deque[float]] = {}
        self._millimetres: dict[str, deque[float]] = {}

    def took(self, name: str, seconds: float) -> None:
        """A deformer answered a frame."""
        self._milliseconds.setdefault(name, deque(maxlen=RECENT)).append(1e3 * seconds)

    def missed(self, name: str, metres: float) -> None:
        """The finite elements, solved to the end, say how far off a deformer was."""
        self._millimetres.setdefault(name, deque(maxlen=RECENT)).append(1e3 * metres)

    @property
    def places(self) -> dict[str, tuple[float, float]]:
        """(ms, mm) of those of which both are known."""
        return {
            name: (float(np.median(self._milliseconds[name])), float(np.median(missed)))
            for name, missed in self._millimetres.items()
            if name in self._milliseconds
        }

    def __str__(self) -> str:
        """One line for a page, fastest first; in bold whom no other equals or beats in both. Empty of none."""
        places = self.places
        best = unbeaten(places)
        told = [
            f"{f'**{name}**' if name in best else name} {ms:.1f} ms, {mm:.3f} mm"
            for name, (ms, mm) in sorted(places.items(), key=lambda item: item[1])
        ]
        return f"so far, a load and its error (bold: nobody is faster and nearer): {' · '.join(told)}" if told else ""
