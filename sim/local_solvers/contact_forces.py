"""Where the few nodes that tools touch come to rest, while all else follows as a quadratic model has it.

With C (3n, 3n) the compliance of the model at these nodes and w0 where they would go untouched, w minimises

    (w - w0) . C^-1 (w - w0) / 2 + c(w) + d |w - v|^2 / 2 over the touched,

c the barrier of tools and d a drag from where they are, v. It is found by Newton's method for the forces f that tools
exert, w = w0 - C f: these are none but at touched nodes, and so C is never inverted. It is given where nodes go under
forces that are nearly right, w1 = w0 - C f1: of differences little is rounded away.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cholesky

from ..discretisation.term import Reduction
from ..linalg.compliance import Compliance
from ..minimisers.compact_lbfgs import Pairs
from ..minimisers.line_search import goes_too_far, kept_of

# A compliance is rounded: this share of its mean makes it definite.
ROUNDED = 1e-6


@dataclass(frozen=True)
class ForceLimits:
    """When Newton's method for the tools' forces ends.

    Parameters
    ----------
    iterations, cuts
        Most, and most cuts of one step.
    most
        Nodes: more that are touched are no few.
    late
        A model that is not convex after so many iterations is not going to be.
    """

    iterations: int = 60
    cuts: int = 20
    most: int = 300
    late: int = 12


FORCES = ForceLimits()


@dataclass(frozen=True, eq=False)
class Softness:
    """C of a model: what a body at rest does, and what was learnt since, at the n nodes of the compliance."""

    rest: Compliance
    pairs: Pairs

    @cached_property
    def _learnt(self) -> np.ndarray:
        return self.pairs.at(self.rest.rows)

    def moved(self, force: np.ndarray) -> np.ndarray:
        """C force (3n,)."""
        return self.rest.moved(force) + (self.pairs.middle @ (self._learnt @ force)) @ self._learnt

    def between(self, some: np.ndarray) -> np.ndarray:
        """C (3a, 3a) between `some` (a,) of the nodes; symmetric but for what the columns were rounded to."""
        learnt = self._learnt[:, _rows(some)]
        own = self.rest.between(some).T + learnt.T @ self.pairs.middle @ learnt
        return own + ROUNDED * np.trace(own) / len(own) * np.eye(len(own))


def settled(
    barrier: Reduction,
    soft: Softness,
    here: np.ndarray,
    there: np.ndarray,
    known: np.ndarray,
    tolerance: float,
    drag: float,
    limits: ForceLimits = FORCES,
) -> np.ndarray | None:
    """The forces f (3n,) [N], from where the nodes are, `here` (3n,) [m]; w1 is `there` and f1 `known` (3n,).

    They are exact to a `tolerance`, relative. `drag` is d in units of how stiff a touched node is. None where the model
    is not convex: its tools are sharper than its tissue is stiff, and it would go far astray.
    """
    touched = _touched(barrier.slope(here))[: limits.most]
    force, held = known.copy(), np.zeros_like(here)
    if len(touched):
        own, rows = soft.between(touched), _rows(touched)
        force[rows] += np.linalg.solve(own, (there - here)[rows])
        held[rows] = drag / np.diag(own).mean()

    def pushed(w: np.ndarray) -> np.ndarray:
        return barrier.slope(w) + held * (w - here)

    w, convex = there - soft.moved(force - known), True
    slope = pushed(w)
    for step in range(limits.iterations):
        left = slope - force
        if np.linalg.norm(left) <= tolerance * np.linalg.norm(slope):
            break
        change, convex = _newton(barrier, soft, w, slope, left, held, limits.most)
        if not convex and step >= limits.late:
            return None
        way = -soft.moved(change)
        promised, t = -float(left @ way), barrier.longest_step(w, way)
        slope = pushed(w + t * way)
        for _ in range(limits.cuts):
            ahead = float((slope - force - t * change) @ way)
            if not goes_too_far(ahead, promised):
                break
            t *= kept_of(ahead, promised)
            slope = pushed(w + t * way)
        force, w = force + t * change, w + t * way
    return force if convex else None


def _newton(
    barrier: Reduction, soft: Softness, w: np.ndarray, slope: np.ndarray, left: np.ndarray, held: np.ndarray, most: int
) -> tuple[np.ndarray, bool]:
    """The change (3n,) of the forces that 1 + D C has for what is `left` (3n,), D = c'' at w; whether it is convex.

    Where it is not, D is taken without what bends. More than the `most` nodes are no few.
    """
    touched, change = _touched(slope), left.copy()
    if not len(touched):
        return change, True
    if len(touched) > most:
        return change, False
    rows = _rows(touched)
    own, along = soft.between(touched), soft.moved(left)[rows]
    root = np.linalg.cholesky(0.5 * (own + own.T))
    convex, curvature = True, barrier.curvature(w, touched, False) + np.diag(held[rows])
    try:
        cholesky(np.eye(len(rows)) + root.T @ curvature @ root)
    except LinAlgError:
        convex, curvature = False, barrier.curvature(w, touched, True) + np.diag(held[rows])
    # C as it was rounded: D is a thousand times as stiff as the tissue.
    change[rows] -= curvature @ np.linalg.solve(np.eye(len(rows)) + own @ curvature, along)
    return change, convex


def _touched(slope: np.ndarray) -> np.ndarray:
    return np.flatnonzero(slope.reshape(-1, 3).any(axis=1))


def _rows(nodes: np.ndarray) -> np.ndarray:
    return (3 * nodes[:, None] + np.arange(3)).ravel()
