"""The evidence of many sets of unknowns at once: what several of them share is eliminated once.

Unknowns are scaled to a prior variance of 1, and data d are whitened. The normal equations have the matrix
M = 1 + A^T A and the right side b = A^T d. But for what all sets share, the logarithm of a set's evidence is
b^T M^-1 b / 2 - log(det M) / 2. Source: Rasmussen, Williams 2006, "Gaussian Processes for Machine Learning", equation
5.8. Both terms are sums over blocks that are eliminated one after another, each from the Schur complement that is
left. Source: Golub, Van Loan 2013, "Matrix Computations", section 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Equations:
    """Stacks (...) of normal equations whose unknowns were eliminated in part. Some of p places may join each.

    Parameters
    ----------
    kind
        (k,) of the unknowns that are left.
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

    def eliminated(self, kind: int) -> Equations:
        """The same without the unknowns of one kind, which take part."""
        chosen, left = np.flatnonzero(self.kind == kind), np.flatnonzero(self.kind != kind)
        kept = np.append(left, np.arange(len(self.kind), self.table.shape[-1]))
        block, rows = self.table[..., chosen[:, None], chosen], self.table[..., chosen[:, None], kept]
        solved = np.linalg.inv(block) @ rows
        table = self.table[..., left[:, None], kept] - rows[..., : len(left)].swapaxes(-1, -2) @ solved
        shape = (*block.shape[:-1], self.place.shape[-3], self.place.shape[-1])
        here, there = (each[..., len(left) :].reshape(shape).swapaxes(-3, -2) for each in (rows, solved))
        place = self.place - here[..., :-1].swapaxes(-1, -2) @ there
        gain = (rows[..., -1] * solved[..., -1]).sum(axis=-1)
        return Equations(self.kind[left], table, place, self.evidence + _logarithm(gain, block))

    def varied(self, kind: int, sizes: np.ndarray) -> Equations:
        """The same (..., b) where unknowns of one kind have b prior standard deviations in turn, in place of 1."""
        own = np.flatnonzero(self.kind == kind)
        size = np.ones((len(sizes), self.table.shape[-1]))
        size[:, own] = sizes[:, None]
        rows = size[:, : len(self.kind), None]
        table = self.table[..., None, :, :] * rows * size[:, None]
        table[..., own, own] += 1.0 - sizes[:, None] ** 2
        return Equations(self.kind, table, self.place[..., None, :, :, :], self.evidence[..., None])

    @property
    def with_places(self) -> np.ndarray:
        """Logarithms (..., p) of the evidence with one place each, of those unknowns that were eliminated."""
        block, data = self.place[..., :-1], self.place[..., -1:]
        gain = (data * np.linalg.solve(block, data)).sum(axis=(-2, -1))
        return self.evidence[..., None] + _logarithm(gain, block)


def _logarithm(gain: np.ndarray, block: np.ndarray) -> np.ndarray:
    return 0.5 * (gain - np.linalg.slogdet(block)[1])
