"""Compact representation of the L-BFGS inverse Hessian, relative to the initial inverse H0.

    H = H0 + [S, H0 Y] M [S, H0 Y]',    M = [[R^-T (D + Y' H0 Y) R^-1, -R^-T], [-R^-1, 0]],

with steps S and gradient changes Y as columns; R is the upper triangle of S' Y and D its diagonal. Byrd, Nocedal,
Schnabel 1994, "Representations of quasi-Newton matrices and their use in limited memory methods", Math. Program.
63:129-156, theorem 2.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..runtime.device import Device
from ..runtime.views import cast_like, select_columns, to_host, to_library, to_view
from .lbfgs_kernels import PAIRS


@dataclass(frozen=True, eq=False)
class CurvaturePairs:
    """Curvature pairs of one load case: s, w = H0 y (m, 3N), oldest first; products s_i . y_j, y_i . w_j (m, m)."""

    s: np.ndarray
    w: np.ndarray
    sy: np.ndarray
    yw: np.ndarray

    @cached_property
    def middle_matrix(self) -> np.ndarray:
        """Middle matrix M (2m, 2m) of the compact representation."""
        return compute_middle_matrix(self.sy, self.yw)

    def compute_weights(self, force: np.ndarray) -> np.ndarray:
        """Return the coefficients M [S, W]' force (2m,) for a force (3N,)."""
        force = force.astype(self.s.dtype)
        return self.middle_matrix @ np.concatenate([self.s @ force, self.w @ force])

    def compute_motion(self, weights: np.ndarray) -> np.ndarray:
        """Return the displacement [S, W] weights (3N,)."""
        some, others = np.split(weights.astype(self.s.dtype), 2)
        return some @ self.s + others @ self.w

    def add_pair(self, s: np.ndarray, y: np.ndarray, w: np.ndarray) -> CurvaturePairs:
        """Return the history with the new pair (3N,) added, without the oldest pair if there are more than `PAIRS`."""
        some = slice(max(0, len(self.s) - PAIRS + 1), None)
        steps, ways = (np.vstack([old[some], new.astype(old.dtype)]) for old, new in ((self.s, s), (self.w, w)))
        sy, yw = np.zeros((2, len(steps), len(steps)))
        sy[:-1, :-1], yw[:-1, :-1] = self.sy[some, some], self.yw[some, some]
        # y . H0 y' = y' . H0 y: products of the new change with old ones, and of old changes with the new step.
        sy[:, -1], yw[:, -1] = steps @ y.astype(steps.dtype), ways @ y.astype(steps.dtype)
        yw[-1] = yw[:, -1]
        return CurvaturePairs(steps, ways, sy, yw)


def build_empty_history(rows: int, dtype: str) -> CurvaturePairs:
    """Return an empty L-BFGS history for one load case with `rows` unknowns, in the type `dtype`."""
    return CurvaturePairs(*np.zeros((2, 0, rows), dtype), *np.zeros((2, 0, 0)))


def compute_middle_matrix(sy: np.ndarray, yw: np.ndarray) -> np.ndarray:
    """Return the middle matrix M (..., 2m, 2m) from s_i . y_j and y_i . w_j (..., m, m); zero pairs have no effect."""
    upper, eye = np.triu(sy), np.eye(sy.shape[-1])
    own = np.diagonal(upper, axis1=-2, axis2=-1)[..., None] * eye
    inverse = np.linalg.inv(upper + np.where(own == 0.0, eye, 0.0))
    corner = inverse.mT @ (own + yw) @ inverse
    return np.block([[corner, -inverse.mT], [-inverse, np.zeros_like(inverse)]])


class BatchHistory:
    """L-BFGS histories of the b load cases of a batch, on the device of the batch.

    Parameters
    ----------
    device
        Device of the arrays.
    rows, columns
        Numbers of unknowns 3N and load cases b.
    """

    def __init__(self, device: Device, rows: int, columns: int):
        self._device = device
        # s and w on the device, their products on the host in float64; pair i of a load case is in slot i modulo PAIRS.
        self._sw = to_view(device.allocate(columns * 2 * PAIRS, rows)).reshape(columns, 2 * PAIRS, rows)
        self._sy, self._yw = np.zeros((2, columns, PAIRS, PAIRS))
        self.count = np.zeros(columns, int)
        self._asked: tuple[np.ndarray, LbfgsHistory] | None = None

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the load cases `columns` (k,) of the batch."""
        self._asked = None
        self._sw = self._sw[columns]
        self._sy, self._yw, self.count = self._sy[columns], self._yw[columns], self.count[columns]

    def clear(self, columns: np.ndarray) -> None:
        """Clear the histories of the load cases `columns` (k,)."""
        self._asked = None
        self._sw[columns], self._sy[columns], self._yw[columns], self.count[columns] = 0.0, 0.0, 0.0, 0

    @property
    def max_pairs(self) -> int:
        """Largest number of pairs of all load cases."""
        return min(int(self.count.max(initial=0)), PAIRS)

    def get_history(self, columns: np.ndarray) -> LbfgsHistory:
        """Return the history of the load cases `columns` (k,); the result is cached for the same columns."""
        if self._asked is not None and np.array_equal(self._asked[0], columns):
            return self._asked[1]
        order = (self.count[columns, None] + np.arange(PAIRS)) % PAIRS  # oldest first
        both = np.concatenate([order, PAIRS + order], axis=1)
        place = columns[:, None, None], order[:, :, None], order[:, None, :]
        middle = np.empty((len(columns), 2 * PAIRS, 2 * PAIRS))
        found = compute_middle_matrix(self._sy[place], self._yw[place])
        middle[np.arange(len(columns))[:, None, None], both[:, :, None], both[:, None, :]] = found
        own = self._sw[select_columns(self._device, columns, len(self.count))]
        history = LbfgsHistory(own, to_library(self._device, middle.astype(self._device.precision)))
        self._asked = columns, history
        return history

    def update_history(self, columns: np.ndarray, s: Any, y: Any, w: Any) -> None:
        """Add a new pair s, y, w (3N, k) to the load cases `columns` (k,), and drop the oldest pair beyond `PAIRS`."""
        self._asked = None
        place, some = self.count[columns] % PAIRS, select_columns(self._device, columns, len(self.count))
        own, at = to_library(self._device, columns), to_library(self._device, place)
        self._sw[own, at], self._sw[own, PAIRS + at] = s.T, w.T
        # y . H0 y' = y' . H0 y: products of the new change with old ones, and of old changes with the new step.
        change = cast_like(self._sw, y.T[:, :, None])
        worth = to_host(self._sw[some] @ change)[:, :, 0].astype(np.float64)
        self._sy[columns, place] = 0.0
        self._sy[columns, :, place] = worth[:, :PAIRS]
        self._yw[columns, :, place] = self._yw[columns, place] = worth[:, PAIRS:]
        self.count[columns] += 1


@dataclass(frozen=True, eq=False)
class LbfgsHistory:
    """Compact L-BFGS representation of k load cases: [S, W]' (k, 2m, 3N) and the middle matrix M (k, 2m, 2m)."""

    sw: Any
    middle_matrix: Any

    def compute_weights(self, force: Any) -> Any:
        """Return the coefficients M [S, W]' force (k, 2m, 1) for forces (3N, k) [N]."""
        return self.middle_matrix @ (self.sw @ force.T[:, :, None])

    def compute_motion(self, weights: Any) -> Any:
        """Return the displacements [S, W] weights (3N, k) [m]."""
        return (weights.mT @ self.sw)[:, 0].T
