"""What L-BFGS learns of a curvature, added to the inverse that it began with.

    H = H0 + [S, H0 Y] M [S, H0 Y]',    M = [[R^-T (D + Y' H0 Y) R^-1, -R^-T], [-R^-1, 0]],

with steps S and changes Y of the gradient as columns, R the upper triangle of S' Y and D its diagonal. Byrd, Nocedal,
Schnabel 1994, "Representations of quasi-Newton matrices and their use in limited memory methods", Math. Program.
63:129-156, theorem 2.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .lbfgs_kernels import PAIRS


@dataclass(frozen=True, eq=False)
class Pairs:
    """s and w = H0 y (m, 3N), oldest first; products s_i . y_j and y_i . w_j (m, m)."""

    s: np.ndarray
    w: np.ndarray
    sy: np.ndarray
    yw: np.ndarray

    @cached_property
    def middle(self) -> np.ndarray:
        """M (2m, 2m)."""
        inverse = np.linalg.inv(np.triu(self.sy))
        corner = inverse.T @ (np.diag(np.diag(self.sy)) + self.yw) @ inverse
        return np.block([[corner, -inverse.T], [-inverse, np.zeros_like(inverse)]])

    def weights(self, force: np.ndarray) -> np.ndarray:
        """M [S, W]' force (2m,), of a force (3N,)."""
        force = force.astype(self.s.dtype)
        return self.middle @ np.concatenate([self.s @ force, self.w @ force])

    def motion(self, weights: np.ndarray) -> np.ndarray:
        """[S, W] weights (3N,)."""
        some, others = np.split(weights.astype(self.s.dtype), 2)
        return some @ self.s + others @ self.w

    def at(self, rows: np.ndarray) -> np.ndarray:
        """[S, W]' (2m, k) at some of the 3N rows (k,)."""
        return np.concatenate([self.s[:, rows], self.w[:, rows]]).astype(np.float64)

    def and_one(self, s: np.ndarray, y: np.ndarray, w: np.ndarray) -> Pairs:
        """With a newer pair (3N,), and the oldest forgotten where there are too many."""
        some = slice(max(0, len(self.s) - PAIRS + 1), None)
        steps, ways = (np.vstack([old[some], new.astype(old.dtype)]) for old, new in ((self.s, s), (self.w, w)))
        sy, yw = np.zeros((2, len(steps), len(steps)))
        sy[:-1, :-1], yw[:-1, :-1] = self.sy[some, some], self.yw[some, some]
        # y . H0 y' = y' . H0 y: what the new change is worth along old ones, and old changes along the new step.
        sy[:, -1], yw[:, -1] = steps @ y.astype(steps.dtype), ways @ y.astype(steps.dtype)
        yw[-1] = yw[:, -1]
        return Pairs(steps, ways, sy, yw)


def no_pairs(rows: int, kind: str) -> Pairs:
    """Nothing learnt yet of a column of `rows`, kept as numbers of a `kind`."""
    return Pairs(*np.zeros((2, 0, rows), kind), *np.zeros((2, 0, 0)))
