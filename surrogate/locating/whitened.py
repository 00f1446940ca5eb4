"""Whitened effect of the unknowns on the observed points: rows with independent errors of variance 1.

Unknowns are scaled to a prior variance of 1, and the data d are whitened. The normal equations have the matrix M = 1 +
A^T A and the right side b = A^T d. The log evidence of a set of unknowns is b^T M^-1 b / 2 - log(det M) / 2, up to a
constant common to all sets. Source: Rasmussen, Williams 2006, "Gaussian Processes for Machine Learning", equation 5.8.
Both terms are sums over blocks of unknowns, eliminated one after the other by Schur complements. Source: Golub, Van
Loan 2013, "Matrix Computations", section 4.2.
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
    """Stack (...) of partly eliminated normal equations; the unknowns of one of p places may be added to each.

    Parameters
    ----------
    kind
        Kind (k,) of each remaining unknown; unknowns of one kind are adjacent.
    products
        Products (..., k, k + p (q + 1)) of the remaining unknowns with each other and with the columns of all places.
    place_products
        Products (..., p, q, q + 1) of the q unknowns of each place with each other and, in the last column, the data.
    log_evidence
        Log evidence (...) of the eliminated unknowns.
    """

    kind: np.ndarray
    products: np.ndarray
    place_products: np.ndarray
    log_evidence: np.ndarray

    def eliminate_unknowns(self, unknown_type: int, is_last: bool = False) -> NormalEquations:
        """Eliminate the unknowns of one kind; if `is_last`, products of other remaining unknowns are dropped."""
        first = int(np.argmax(self.kind == unknown_type))
        end = first + np.count_nonzero(self.kind == unknown_type)
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

    def scale_unknowns(self, unknown_type: int, deviations: np.ndarray) -> NormalEquations:
        """Return equations (..., b) with b prior standard deviations for the unknowns of one kind, instead of 1."""
        own = np.flatnonzero(self.kind == unknown_type)
        size = np.ones((len(deviations), self.products.shape[-1]))
        size[:, own] = deviations[:, None]
        rows = size[:, : len(self.kind), None]
        table = self.products[..., None, :, :] * rows * size[:, None]
        table[..., own, own] += 1.0 - deviations[:, None] ** 2
        return NormalEquations(self.kind, table, self.place_products[..., None, :, :, :], self.log_evidence[..., None])


def add_place_unknowns(equations: Sequence[NormalEquations]) -> np.ndarray:
    """Compute the log evidence (n, ..., p) of n equations with the unknowns of each of p places added."""
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
    """Whitened rows (m,) of the unknowns (weights of r shapes, rigid error) and of the data.

    The rows of a shape are `weights` times the shape's motions at the vertices. As many points depend on few vertices,
    this form needs fewer numbers.

    Parameters
    ----------
    whitening
        Transform of the data to independent errors.
    weights
        Whitened `Evidence.weights` (m / c, v c'): c = 3 and c' = 1 if rows have three axes, else c = 1 and c' = 3.
    shape
        Motions (v c', c r) [m] of the vertices for each shape.
    rigid_rows
        Rows (m, 7) of the rigid error, for one standard deviation of each component, and of the data.
    """

    whitening: Whitening
    weights: np.ndarray
    shape: np.ndarray
    rigid_rows: np.ndarray

    def apply_precision(self, columns: np.ndarray) -> np.ndarray:
        """Compute the errors' inverse covariance times the rows (m, k) of some `columns` (k,): unknowns or data."""
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
        """Inner products (r + 7, r + 7) of the rows of all unknowns and of the data, which are last."""
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
    """Build whitened rows of a prior's shapes and of evidence, with the model error for motions of a size [m]."""
    whitening = evidence.build_whitening(motion_size)
    vertices, weights = evidence.weights
    shape = prior.restrict_to_vertices(vertices).reshape(weights.shape[1], -1).astype(float)
    rest = np.column_stack([evidence.rigid_jacobian * evidence.rigid_scale, evidence.motion])
    return WhitenedSystem(whitening, whitening.root @ weights, shape, whitening.whiten(rest))
