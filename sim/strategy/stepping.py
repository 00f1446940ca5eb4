"""Control of load steps, and of the contact gap while tools move along a long path."""

from dataclasses import dataclass
from typing import Self

import numpy as np


@dataclass(frozen=True)
class LoadStepping:
    """Control of load steps.

    Parameters
    ----------
    first_step, min_step, failure_factor
        First step and smallest step, as fractions of the load; factor on a step that failed.
    target_iterations, max_iterations
        Outer iterations per step: target, which determines the length of the next step, and maximum.
    patience
        Stepping ends if the batch needs more than this factor times `Accuracy.inner` linear iterations per good step.
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
    """Control of the contact gap, which is widened for a long tool path and closed again.

    Parameters
    ----------
    max_gaps, closing_factor
        If tools move more than this number of gaps at once, the gap is first widened by a power of `closing_factor`.
    tolerance
        Tolerance of the relative residual while the gap is widened.
    failure_factor
        Factor on the gap after a failed step, which is repeated with a shorter length.
    max_contact_iterations, newton_residual
        Maximum iterations of the contact solver. If the contact solver ends with a residual of at most
        `newton_residual`, Newton's method continues from there with the same maximum.
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
    """Progress of load cases whose load or tool motion is applied in steps; all arrays are changed in place.

    Parameters
    ----------
    reached_fraction, next_step
        Fraction (b,) of the load at the last equilibrium, and length (b,) of the next step.
    path_in_gaps
        Length (b,) of the whole tool path, in units of the gap.
    """

    reached_fraction: np.ndarray
    next_step: np.ndarray
    path_in_gaps: np.ndarray

    @classmethod
    def start(cls, first_step: float, gaps: np.ndarray) -> Self:
        """Return the progress at fraction 0, with a next step of length `first_step`."""
        return cls(np.zeros(len(gaps)), np.full(len(gaps), first_step), gaps)

    def limit_steps(self, max_steps: np.ndarray, stepping: LoadStepping) -> tuple[np.ndarray, np.ndarray]:
        """Limit steps to `max_steps` (b,); return masks (b,) of cases with shorter steps and of cases to continue."""
        shorter = self.next_step < max_steps
        np.minimum(self.next_step, max_steps, out=self.next_step)
        long_enough = self.next_step >= stepping.min_step * np.minimum(1.0, 4.0 * max_steps)
        return shorter, (self.reached_fraction < 1.0) & long_enough

    def propose_fractions(self, rows: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the next fractions (k,) of the cases `rows` (k,), and the longest path of their tools [gaps]."""
        aim = np.minimum(self.reached_fraction[rows] + self.next_step[rows], 1.0)
        return aim, float(((aim - self.reached_fraction[rows]) * self.path_in_gaps[rows]).max())

    def take_steps(self, rows: np.ndarray, fractions: np.ndarray, good: np.ndarray) -> None:
        """Accept the steps of those cases `rows` (k,) that are `good`, and set their fraction to `fractions` (k,)."""
        self.reached_fraction[rows[good]] = fractions[good]

    def resize_steps(self, rows: np.ndarray, good: np.ndarray, growth: np.ndarray, shrink: float, widen: float) -> None:
        """Increase the steps of `good` cases in `rows` (k,); multiply other steps by `shrink`, and gaps by `widen`."""
        self.path_in_gaps[rows] *= np.where(good, 1.0, widen)
        self.next_step[rows] *= np.where(good, np.clip(growth, 0.5, 2.0), shrink)
