"""What unknowns do at the points that are seen, in rows whose errors are independent and of variance 1."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .evidence import Evidence, Whitening
from .prior import Prior


@dataclass(frozen=True, eq=False)
class Whitened:
    """Rows (m,) of unknowns, which are weights of r shapes and a rigid error, and of what is seen.

    A shape's rows are `weights` times its motions at the vertices: many points see few vertices, so that products
    of rows are had from fewer numbers.

    Parameters
    ----------
    whitening
        What made errors independent.
    weights
        (m / c, v c'), as those of `Evidence.weights` and whitened. Rows of c = 3 axes see c' = 1 axis at once.
    shape
        (v c', c r) [m]: motions of the vertices.
    rest
        (m, 7): what a rigid error of one standard deviation does, and what is seen.
    """

    whitening: Whitening
    weights: np.ndarray
    shape: np.ndarray
    rest: np.ndarray

    def precise(self, columns: np.ndarray) -> np.ndarray:
        """The errors' inverse covariance times rows (m, k) of some of the unknowns and of what is seen (k,)."""
        shapes = columns < self._shapes
        found, back = np.empty((len(self.rest), len(columns))), self.whitening.back
        some = self.shape.reshape(-1, self._shapes)[:, columns[shapes]].reshape(len(self.shape), -1)
        root = self.whitening.root.T
        found[:, shapes] = np.linalg.multi_dot([root, self.weights, some]).reshape(len(found), -1)
        found[:, ~shapes] = back(self.rest[:, columns[~shapes] - self._shapes])
        return found

    @property
    def _shapes(self) -> int:
        return self.shape.shape[1] * len(self.weights) // len(self.rest)

    @cached_property
    def products(self) -> np.ndarray:
        """(r + 7, r + 7): of the rows of unknowns, and of what is seen as the last, with each other."""
        count, tall = self._shapes, len(self.weights) > 2 * len(self.shape)
        few = np.linalg.qr(self.weights, mode="r") if tall else self.weights
        rows = (few @ self.shape).reshape(-1, count)
        across = self.weights.T @ self.rest.reshape(len(self.weights), -1)
        found = np.empty((count + 7, count + 7))
        found[:count, :count] = rows.T @ rows
        found[:count, count:] = self.shape.reshape(-1, count).T @ across.reshape(-1, 7)
        found[count:, :count] = found[:count, count:].T
        found[count:, count:] = self.rest.T @ self.rest
        return found


def whitened(prior: Prior, evidence: Evidence, seen: float) -> Whitened:
    """Rows of a prior's shapes and of evidence, where shapes lack what belongs to motions of `seen` [m]."""
    whitening = evidence.whitening(seen)
    vertices, weights = evidence.weights
    shape = prior.at_vertices(vertices).reshape(weights.shape[1], -1).astype(float)
    rest = np.column_stack([evidence.rigid * evidence.rigid_scale, evidence.value])
    return Whitened(whitening, whitening.root @ weights, shape, whitening.white(rest))
