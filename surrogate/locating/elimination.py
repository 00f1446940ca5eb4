"""The evidence of many sets of unknowns at once: what several of them share is eliminated once.

Unknowns are scaled to a prior variance of 1, and data d are whitened. The normal equations have the matrix
M = 1 + A^T A and the right side b = A^T d. But for what all sets share, the logarithm of a set's evidence is
b^T M^-1 b / 2 - log(det M) / 2. Source: Rasmussen, Williams 2006, "Gaussian Processes for Machine Learning", equation
5.8. Both terms are sums over blocks that are eliminated one after another, each from the Schur complement that is
left. Source: Golub, Van Loan 2013, "Matrix Computations", section 4.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Equations:
    """Stacks (...) of normal equations whose unknowns were eliminated in part. Some of p places may join each.

    Parameters
    ----------
    kind
        (k,) of the unknowns that are left; those of one kind are adjacent.
    table
        (..., k, k + p (q + 1)): their products with each other, and with what stands in `place`.
    place
        (..., p, q, q + 1): products of the q unknowns of each place with each other and with the data, which come last.
    evidence
        (...): logarithm of that of the unknowns that were eliminated.
    """

    kind: np.ndarray
    table: np.ndarray
    place: np.ndarray
    evidence: np.ndarray

    def eliminated(self, kind: int, last: bool = False) -> Equations:
        """Eliminate the unknowns of one kind; the `last` elimination leaves no `table`."""
        first = int(np.argmax(self.kind == kind))
        end = first + np.count_nonzero(self.kind == kind)
        own, left = slice(first, end), np.delete(self.kind, slice(first, end))
        block = self.table[..., own, own]
        rows = np.concatenate([self.table[..., own, :first], self.table[..., own, end:]], axis=-1)
        solved = np.linalg.inv(block) @ rows
        shape = (*block.shape[:-1], self.place.shape[-3], self.place.shape[-1])
        here, there = (each[..., len(left) :].reshape(shape).swapaxes(-3, -2) for each in (rows, solved))
        place = self.place - here[..., :-1].swapaxes(-1, -2) @ there
        gain = (rows[..., -1] * solved[..., -1]).sum(axis=-1)
        evidence = self.evidence + _logarithm(gain, block)
        if last:
            return Equations(left[:0], rows[..., :0, len(left) :], place, evidence)
        table = rows[..., : len(left)].swapaxes(-1, -2) @ -solved
        for there, here in ((slice(first), slice(first)), (slice(first, None), slice(end, None))):
            table[..., there, :first] += self.table[..., here, :first]
            table[..., there, first:] += self.table[..., here, end:]
        return Equations(left, table, place, evidence)

    def varied(self, kind: int, sizes: np.ndarray) -> Equations:
        """The same (..., b) where unknowns of one kind have b prior standard deviations in turn, in place of 1."""
        own = np.flatnonzero(self.kind == kind)
        size = np.ones((len(sizes), self.table.shape[-1]))
        size[:, own] = sizes[:, None]
        rows = size[:, : len(self.kind), None]
        table = self.table[..., None, :, :] * rows * size[:, None]
        table[..., own, own] += 1.0 - sizes[:, None] ** 2
        return Equations(self.kind, table, self.place[..., None, :, :, :], self.evidence[..., None])


def with_places(several: Sequence[Equations]) -> np.ndarray:
    """Logarithms (n, ..., p) of the evidence of n equations with one place each, of the unknowns eliminated so far."""
    # Blocks are small and many: Gaussian elimination of all at once takes a tenth of the time of a library's calls.
    table = np.ascontiguousarray(np.moveaxis(np.stack([each.place for each in several]), (-2, -1), (0, 1)))
    found = np.stack([each.evidence for each in several])[..., None]
    for row in range(len(table)):
        pivot = table[row, row]
        share = table[row, row + 1 :] / pivot
        found = found + 0.5 * (table[row, -1] * share[-1] - np.log(pivot))
        table[row + 1 :, row + 1 :] -= table[row, row + 1 : -1, None] * share
    return found


def _logarithm(gain: np.ndarray, block: np.ndarray) -> np.ndarray:
    return 0.5 * (gain - np.linalg.slogdet(block)[1])
