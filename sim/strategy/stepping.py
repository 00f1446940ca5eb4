"""Control of load steps, and of the gap of tools on a long path."""

from dataclasses import dataclass
from typing import Self

import numpy as np


@dataclass(frozen=True)
class LoadStepping:
    """Control of load steps.

    Parameters
    ----------
    first_step, min_step, failure_factor
        Fractions of the load: first step, smallest step; factor on a step that failed.
    target_iterations, max_iterations
        Outer iterations per step: target that sets the length of the next step; maximum.
    patience
        Steps end when the batch has spent this number of times `Accuracy.inner` linear iterations per successful step.
    """

    first_step: float = 1.0 / 4.0
    min_step: float = 1.0 / 64.0
    failure_factor: float = 1.0 / 4.0
    target_iterations: int = 8
    max_iterations: int = 15
    patience: int = 4


LOAD_STEPPING = LoadStepping()  # Default.


@dataclass(frozen=True)
class GapContinuation:
    """Control of the tools' gap, which is widened for a long path and closed again.

    Parameters
    ----------
    max_gaps, closing_factor
        Tools that move more than this number of gaps at once start with a gap widened by a power of `closing_factor`.
    tolerance
        Relative residual until the gap has its own width.
    failure_factor
        Factor on the gap after a step that failed, which is tried again, shorter.
    max_contact_iterations, newton_residual
        Maximum iterations of the contact solver before Newton. If it ends with a residual of at most
        `newton_residual`, Newton continues from there with the same maximum.
    """

    max_gaps: float = 8.0
    closing_factor: float = 4.0
    tolerance: float = 0.05
    failure_factor: float = 16.0
    max_contact_iterations: int = 60
    newton_residual: float = 0.1


GAP_CONTINUATION = GapContinuation()  # Default.


@dataclass(frozen=True, eq=False)
class LoadProgress:
    """Progress of cases whose load, or whose tools' motion, is applied in steps; all arrays are changed in place.

    Parameters
    ----------
    reached, step
        (b,) fractions: last equilibrium, and length of the next step.
    gaps
        (b,) length of the tools' whole path [gaps], at least.
    """

    reached: np.ndarray
    step: np.ndarray
    gaps: np.ndarray

    @classmethod
    def start(cls, first: float, gaps: np.ndarray) -> Self:
        """Return cases at the fraction 0, with a `first` step of this length."""
        return cls(np.zeros(len(gaps)), np.full(len(gaps), first), gaps)

    def limit_steps(self, max_steps: np.ndarray, stepping: LoadStepping) -> tuple[np.ndarray, np.ndarray]:
        """Limit steps to the `max_steps` (b,); return which (b,) bool were shorter, and which cases continue."""
        shorter = self.step < max_steps
        np.minimum(self.step, max_steps, out=self.step)
        long_enough = self.step >= stepping.min_step * np.minimum(1.0, 4.0 * max_steps)
        return shorter, (self.reached < 1.0) & long_enough

    def propose_shares(self, rows: np.ndarray) -> tuple[np.ndarray, float]:
        """Propose the next fractions (k,) of some rows (k,); return them and the longest path of their tools [gaps]."""
        aim = np.minimum(self.reached[rows] + self.step[rows], 1.0)
        return aim, float(((aim - self.reached[rows]) * self.gaps[rows]).max())

    def take_steps(self, rows: np.ndarray, target: np.ndarray, good: np.ndarray) -> None:
        """Accept the steps of those rows (k,) that are `good`: they reach their target (k,)."""
        self.reached[rows[good]] = target[good]

    def resize_steps(self, rows: np.ndarray, good: np.ndarray, growth: np.ndarray, shrink: float, widen: float) -> None:
        """Grow the steps of rows (k,) that are `good`; multiply the others by `shrink`, and their gaps by `widen`."""
        self.gaps[rows] *= np.where(good, 1.0, widen)
        self.step[rows] *= np.where(good, np.clip(growth, 0.5, 2.0), shrink)
