"""How load steps grow and shrink, and how the gaps of tools are opened for a long way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np


@dataclass(frozen=True)
class LoadStepping:
    """How load steps grow, shrink and end.

    Parameters
    ----------
    first, least, cut
        Shares of the load: of the first step, of the shortest, and what is left of a step that failed.
    aimed, most
        The next step is as long as lets expect so many outer iterations. One that takes more than the most is too long.
    patience
        Steps end when the batch has spent so many times the linear iterations that one outer iteration may take.
    """

    first: float = 1.0 / 4.0
    least: float = 1.0 / 64.0
    cut: float = 1.0 / 4.0
    aimed: int = 8
    most: int = 15
    patience: int = 4


STEPPING = LoadStepping()


@dataclass(frozen=True)
class GapContinuation:
    """How the gap of tools is opened for a long way, and closed again.

    Parameters
    ----------
    wide_enough, closing
        Tools that go farther than so many gaps at once begin with a gap that is wider by a power of the closing.
    tolerance
        To which tissue is solved until the gap is the tools' own.
    wider
        A step that failed is tried again, shorter, from a gap so many times as wide.
    alone, nearly
        Contact is solved apart in so many iterations first. Where that ends so near, Newton goes on in as many.
    """

    wide_enough: float = 8.0
    closing: float = 4.0
    tolerance: float = 0.05
    wider: float = 16.0
    alone: int = 60
    nearly: float = 0.1


GAPS = GapContinuation()


@dataclass(frozen=True, eq=False)
class Shares:
    """Cases that are raised, or whose tools are moved, in steps: all arrays are changed in place.

    Parameters
    ----------
    reached, step
        (b,) shares: where an equilibrium was found, and how long the next step is.
    gaps
        (b,) gaps of their tools that the whole way measures, at least.
    """

    reached: np.ndarray
    step: np.ndarray
    gaps: np.ndarray

    @classmethod
    def at_rest(cls, first: float, gaps: np.ndarray) -> Self:
        """Cases at the share 0, whose `first` step is so long."""
        return cls(np.zeros(len(gaps)), np.full(len(gaps), first), gaps)

    def limit(self, longest: np.ndarray, stepping: LoadStepping) -> tuple[np.ndarray, np.ndarray]:
        """Limit steps to the `longest` (b,) at once; which (b,) bool are shorter than that, and which cases go on."""
        shorter = self.step < longest
        np.minimum(self.step, longest, out=self.step)
        long_enough = self.step >= stepping.least * np.minimum(1.0, 4.0 * longest)
        return shorter, (self.reached < 1.0) & long_enough

    def propose_shares(self, rows: np.ndarray) -> tuple[np.ndarray, float]:
        """Shares (k,) that some rows (k,) step to, and the most gaps that their tools go."""
        aim = np.minimum(self.reached[rows] + self.step[rows], 1.0)
        return aim, float(((aim - self.reached[rows]) * self.gaps[rows]).max())

    def take(self, rows: np.ndarray, aim: np.ndarray, good: np.ndarray) -> None:
        """Take the steps of those rows (k,) that are `good`: they reach their aim (k,)."""
        self.reached[rows[good]] = aim[good]

    def resize(self, rows: np.ndarray, good: np.ndarray, growth: np.ndarray, cut: float, wider: float) -> None:
        """Let steps of rows (k,) that are `good` grow; the others are `cut`, and begin from a gap so much `wider`."""
        self.gaps[rows] *= np.where(good, 1.0, wider)
        self.step[rows] *= np.where(good, np.clip(growth, 0.5, 2.0), cut)
