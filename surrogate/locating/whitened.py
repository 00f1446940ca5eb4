"""Whitened effect of the unknowns on observed points: rows with independent errors of variance 1.

Unknowns are scaled to a prior variance of 1, and data d are whitened. The normal equations have the matrix M = 1 + A^T
A and the right side b = A^T d. Up to a constant that all sets share, the logarithm of a set's evidence is b^T M^-1 b /
2 - log(det M) / 2. Source: Rasmussen, Williams 2006, "Gaussian Processes for Machine Learning", equation 5.8. Both
terms are sums over blocks that are eliminated one after another, each from the Schur complement that is left. Source:
Golub, Van Loan 2013, "Matrix Computations", section 4.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .evidence import Evidence, Whitening
from .prior import MotionPrior


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Stacks (...) of partly eliminated normal equations, to which the unknowns of one of p places may be added.

    Parameters
    ----------
    kind
        (k,) of the remaining unknowns; those of one kind are adjacent.
    products
        (..., k, k + p (q + 1)): their products with each other, and with the columns of `place_products`.
    place_products
        (..., p, q, q + 1): products of the q unknowns of each place with each other and with the data, which come last.
    log_evidence
        (...): log evidence of the eliminated unknowns.
    """

    kind: np.ndarray
    products: np.ndarray
    place_products: np.ndarray
    log_evidence: np.ndarray

    def eliminate_unknowns(self, kind: int, is_last: bool = False) -> NormalEquations:
        """Eliminate the unknowns of one kind; the `is_last` elimination leaves no `table`."""
        first = int(np.argmax(self.kind == kind))
        end = first + np.count_nonzero(self.kind == kind)
        own, left = slice(first, end), np.delete(self.kind, slice(first, end))
        block = self.products[..., own, own]
        rows = np.concatenate([self.products[..., own, :first], self.products[..., own, end:]], axis=-1)
        solved = np.linalg.inv(block) @ rows
        shape = (*block.shape[:-1], self.place_products.shape[-3], self.place_products.shape[-1])
        here, there = (each[..., len(left) :].reshape(shape).swapaxes(-3, -2) for each in (rows, solved))
        place = self.place_products - here[..., :-1].swapaxes(-1, -2) @ there
        gain = (rows[..., -1] * solved[..., -1]).sum(axis=-1)
        evidence = self.log_evidence + 0.5 * (gain - np.linalg.slogdet(block)[1])
        if is_last:
            return NormalEquations(left[:0], rows[..., :0, len(left) :], place, evidence)
        table = rows[..., : len(left)].swapaxes(-1, -2) @ -solved
        for there, here in ((slice(first), slice(first)), (slice(first, None), slice(end, None))):
            table[..., there, :first] += self.products[..., here, :first]
            table[..., there, first:] += self.products[..., here, end:]
        return NormalEquations(left, table, place, evidence)

    def scale_unknowns(self, kind: int, deviations: np.ndarray) -> NormalEquations:
        """Return equations (..., b) in which unknowns of one kind have b prior standard deviations, instead of 1."""
        own = np.flatnonzero(self.kind == kind)
        size = np.ones((len(deviations), self.products.shape[-1]))
        size[:, own] = deviations[:, None]
        rows = size[:, : len(self.kind), None]
        table = self.products[..., None, :, :] * rows * size[:, None]
        table[..., own, own] += 1.0 - deviations[:, None] ** 2
        return NormalEquations(self.kind, table, self.place_products[..., None, :, :, :], self.log_evidence[..., None])


def add_place_unknowns(equations: Sequence[NormalEquations]) -> np.ndarray:
    """Compute logarithms (n, ..., p) of the evidence of n equations with one place each, of the eliminated unknowns."""
    # Blocks are small and many: Gaussian elimination of all at once takes a tenth of the time of library calls.
    table = np.ascontiguousarray(np.moveaxis(np.stack([each.place_products for each in equations]), (-2, -1), (0, 1)))
    found = np.stack([each.log_evidence for each in equations])[..., None]
    for row in range(len(table)):
        pivot = table[row, row]
        share = table[row, row + 1 :] / pivot
        found = found + 0.5 * (table[row, -1] * share[-1] - np.log(pivot))
        table[row + 1 :, row + 1 :] -= table[row, row + 1 : -1, None] * share
    return found


@dataclass(frozen=True, eq=False)
class WhitenedSystem:
    """Whitened rows (m,) of unknowns (weights of r shapes, rigid error) and of the data.

    A shape's rows are `weights` times its motions at the vertices: many points depend on few vertices, so that products
    of rows need fewer numbers.

    Parameters
    ----------
    whitening
        Transform to independent errors.
    weights
        (m / c, v c'), as those of `Evidence.weights` and whitened. Rows of c = 3 axes use c' = 1 axis at once.
    shape
        (v c', c r) [m]: motions of the vertices.
    rigid_rows
        (m, 7): rows of a rigid error of one standard deviation, and the data.
    """

    whitening: Whitening
    weights: np.ndarray
    shape: np.ndarray
    rigid_rows: np.ndarray

    def apply_precision(self, columns: np.ndarray) -> np.ndarray:
        """Compute the errors' inverse covariance times rows (m, k) of some of the unknowns and of the data (k,)."""
        shapes = columns < self._shapes
        found, back = np.empty((len(self.rigid_rows), len(columns))), self.whitening.transform_back
        some = self.shape.reshape(-1, self._shapes)[:, columns[shapes]].reshape(len(self.shape), -1)
        root = self.whitening.root.T
        found[:, shapes] = np.linalg.multi_dot([root, self.weights, some]).reshape(len(found), -1)
        found[:, ~shapes] = back(self.rigid_rows[:, columns[~shapes] - self._shapes])
        return found

    @property
    def _shapes(self) -> int:
        return self.shape.shape[1] * len(self.weights) // len(self.rigid_rows)

    @cached_property
    def products(self) -> np.ndarray:
        """(r + 7, r + 7): inner products of the rows of unknowns and of the data, which come last."""
        count, tall = self._shapes, len(self.weights) > 2 * len(self.shape)
        few = np.linalg.qr(self.weights, mode="r") if tall else self.weights
        rows = (few @ self.shape).reshape(-1, count)
        across = self.weights.T @ self.rigid_rows.reshape(len(self.weights), -1)
        found = np.empty((count + 7, count + 7))
        found[:count, :count] = rows.T @ rows
        found[:count, count:] = self.shape.reshape(-1, count).T @ across.reshape(-1, 7)
        found[count:, :count] = found[:count, count:].T
        found[count:, count:] = self.rigid_rows.T @ self.rigid_rows
        return found


def whiten_system(prior: MotionPrior, evidence: Evidence, motion_size: float) -> WhitenedSystem:
    """Build whitened rows of a prior's shapes and of evidence, with the model error of motions of a size [m]."""
    whitening = evidence.build_whitening(motion_size)
    vertices, weights = evidence.weights
    shape = prior.restrict_to_vertices(vertices).reshape(weights.shape[1], -1).astype(float)
    rest = np.column_stack([evidence.rigid_jacobian * evidence.rigid_scale, evidence.motion])
    return WhitenedSystem(whitening, whitening.root @ weights, shape, whitening.whiten(rest))
