"""Which of the pairs of a registration does not fit the others, and by how much more than they allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import f

from .registration import FEWEST_PAIRS, LEAST, registered, slopes_of

# The share of sound sets in which any pair is called suspect.
FALSE_ALARM = 0.05


@dataclass(frozen=True, eq=False)
class PairResiduals:
    """How n pairs of points fit one another.

    Parameters
    ----------
    off
        (n,) [m]: how far each is from where the registration by all has it.
    left_out
        (n,) [m]: how far from where the registration by the others has it.
    studentised
        (n,): the latter, over the deviation that the others' scatter gives it along and about all axes. NaN of three
        pairs, which leave nothing to tell scatter by.
    chance
        How often a set without a wrong pair has one that fits as badly as the worst of these; NaN as above.
    """

    off: np.ndarray
    left_out: np.ndarray
    studentised: np.ndarray
    chance: float

    @property
    def worst(self) -> int:
        """The number from 0 of the pair that fits the others worst."""
        return int(np.argmax(self.left_out if np.isnan(self.studentised).any() else self.studentised))

    @property
    def suspect(self) -> bool:
        """Whether the worst fits worse than in all but `FALSE_ALARM` of sound sets."""
        return self.chance < FALSE_ALARM


def pair_residuals(scan: np.ndarray, patient: np.ndarray) -> PairResiduals:
    """How pairs of points (n, 3) [m], in the scan and in the reference's frame, fit one another.

    Externally studentised residuals, of three coordinates each (Cook, Weisberg 1982, "Residuals and influence in
    regression"). Their squares are F-distributed with 3 and 3 n - 9 degrees of freedom. The chance of the worst is
    that by Bonferroni.

    Raises
    ------
    ValueError
        As `registered`.
    """
    found = registered(scan, patient)
    T, count = found.T_patient_scan, len(scan)
    off = scan @ T[:3, :3].T + T[:3, 3] - patient
    if count == FEWEST_PAIRS:
        # One pair of three, left out, leaves two points: they determine no registration.
        none = np.full(count, np.nan)
        return PairResiduals(np.linalg.norm(off, axis=1), none, none, np.nan)
    J = slopes_of(T, scan, found.centre)
    hat = J @ np.linalg.solve(J.T @ J, J.T)
    freedom = 3 * count - 9
    free = np.stack([np.eye(3) - hat[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(count)])
    left_out = np.linalg.solve(free, off[..., None])[..., 0]
    own = np.einsum("ni,ni->n", off, left_out)
    others = np.maximum((np.square(off).sum() - own) / freedom, LEAST**2)
    squares = own / (3.0 * others)
    chance = min(1.0, count * float(f.sf(squares.max(), 3, freedom)))
    return PairResiduals(np.linalg.norm(off, axis=1), np.linalg.norm(left_out, axis=1), np.sqrt(squares), chance)
