"""A rigid ball on linear tissue: what needs no learning where the tool's pose is known.

The body is condensed to the nodes that a tool may touch: u = C f, C their compliance at rest. Of all frictionless
forces that keep the ball out of every facet it bears those of least energy f.Cf / 2 (Signorini's problem). A ball
touches a flat facet in one point, that nearest to its middle. So constraints are added where a facet is entered, until
none is (the exchange method: Hettich, Kortanek 1993, "Semi-infinite programming", SIAM Rev. 35:380-429), each
linearised where its point has come to: a distance from a point is convex, so that what satisfies the linear ones
satisfies all. Their multipliers are a nonnegative least-squares problem (Lawson, Hanson 1974, "Solving Least Squares
Problems", chapter 23). Stiffness cancels: how stiff tissue is need not be known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.optimize import nnls

from sim.effects import ToolContact
from sim.geometry.closest_point import bounding_balls
from sim.runtime.threads import one_thread
from sim.tools import Ball

# Finite elements keep tissue within a gap of the ball [m]: on average half of it.
THICKER = 0.5 * ToolContact((Ball(1.0),)).gap
# Facets within so many radii of the middle may come to touch.
REACH = 1.5
# A facet entered by less [m], and motions smaller than that, end the search, which so many rounds bound.
TOLERANCE, MOST = 1e-6, 60
# Constraints that bear nothing are dropped, which is faster; after so many rounds they stay: nothing goes in circles.
FORGETFUL = 15
# Places that give less than this share of what nodes do on average are bone's, which the ball enters: no force, or one
# beyond all bounds, would keep it out.
LEAST = 0.02
# Straight from LAPACK: the problems are so small that a wrapper takes longer than the work.
FACTORED, SOLVED = get_lapack_funcs(("potrf", "trtrs"), dtype=np.float64)
# The corner after each of a triangle.
NEXT = np.array([1, 2, 0])
# Points of neighbouring facets on a common edge are one: of the mean diagonal, so that their forces are distinct.
APART = 1e-6


@dataclass(eq=False)
class Contact:
    """A regressor that predicts the response to one metre of indentation, from `tool_features` of an indentation.

    What nonlinearity adds far from the ball is nearly a factor of the force, that grows with depth over radius: a line,
    which is all that is learned.

    Parameters
    ----------
    points
        (k, 3) [m] of the nodes that a tool may touch.
    triangles
        (S, 3) positions in `points`.
    compliance
        (3 k, 3 k) [m/N] float32.
    answers
        (3 k, r) [1/N] float32: coefficients of the basis's modes that unit forces have.
    line
        (2, r): at no depth, and what a depth of one radius adds.
    grip
        (2,): the same factor of the force that the ball exerts; (0,) where none was learned.
    """

    points: np.ndarray
    triangles: np.ndarray
    compliance: np.ndarray
    answers: np.ndarray
    line: np.ndarray
    grip: np.ndarray = field(default_factory=lambda: np.zeros(0))
    # Features that were last asked for, and their forces: motion and reaction of one load are had from one search.
    _last: tuple[bytes, np.ndarray] = field(default=(b"", np.zeros(0)), init=False, repr=False)

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of `tool_features` (B, 8), whose force is depth [m]."""
        found = self.linear(X)
        return (found * (self.line[0] + (X[:, 6:7] / X[:, 7:8]) * self.line[1])).astype(np.float32)

    def linear(self, X: np.ndarray) -> np.ndarray:
        """The same (B, r) of tissue that is linear."""
        return self.force(X).astype(np.float32) @ self.answers / np.maximum(X[:, 6:7], np.finfo(np.float32).tiny)

    def exerted(self, X: np.ndarray) -> np.ndarray:
        """The force (B, 3) [N/m] that the ball exerts, by one metre of depth; `grip` must have been learned."""
        return self._resultant(X) * (self.grip[0] + (X[:, 6:7] / X[:, 7:8]) * self.grip[1])

    def _resultant(self, X: np.ndarray) -> np.ndarray:
        """The same (B, 3) of tissue that is linear."""
        whole = self.force(X).reshape(len(X), -1, 3).sum(axis=1)
        return whole / np.maximum(X[:, 6:7], np.finfo(np.float32).tiny)

    def force(self, X: np.ndarray) -> np.ndarray:
        """What the ball does to linear tissue at the nodes that it may touch (B, 3 k) [N]."""
        asked, (known, found) = X.tobytes(), self._last
        if asked == known:
            return found
        out = np.zeros((len(X), len(self.compliance)))
        with one_thread():
            for row in np.flatnonzero(X[:, 6] > 0.0):
                point, direction, depth, radius = X[row, :3], X[row, 3:6], X[row, 6], X[row, 7]
                out[row] = self._pressed(point + (depth - radius) * direction, radius + THICKER)
        out.flags.writeable = False
        self._last = asked, out
        return out

    def fitted(self, X: np.ndarray, Y: np.ndarray, alike: np.ndarray, exerted: np.ndarray | None = None) -> Self:
        """With the lines that fit coefficients Y (B, r) best; `alike` (r,) numbers those that share one.

        `exerted` (B, 3) [N/m] is the ball's force by one metre of depth, where it is known.
        """
        found, line = self.linear(X), np.zeros_like(self.line)
        for each in np.unique(alike):
            mine = alike == each
            line[:, mine] = _line(X, found[:, mine], Y[:, mine])[:, None]
        grip = self.grip if exerted is None else _line(X, self._resultant(X), exerted)
        return replace(self, line=line, grip=grip)

    def state(self) -> dict[str, np.ndarray]:
        """All that it has."""
        return {item.name: getattr(self, item.name) for item in fields(self) if item.init}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """From `state`."""
        return cls(**state)

    @cached_property
    def _rounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles (S, 3) and radii (S,) [m] of balls that hold a triangle each."""
        return bounding_balls(self.points[self.triangles])

    def _pressed(self, middle: np.ndarray, radius: float) -> np.ndarray:
        """Nodal forces (3 k,) [N] of a ball."""
        around, wide = self._rounds
        some = np.flatnonzero(np.linalg.norm(around - middle, axis=1) - wide < REACH * radius)
        corners = self.points[self.triangles[some]]
        near = distances(corners, nearest_shares(corners, middle), middle)[0] < REACH * radius
        nodes, table = np.unique(self.triangles[some[near]], return_inverse=True)
        rows = (3 * nodes[:, None] + np.arange(3)).ravel()
        compliance = self.compliance[np.ix_(rows, rows)].astype(np.float64)
        own = compliance.reshape(len(nodes), 3, len(nodes), 3)[np.arange(len(nodes)), :, np.arange(len(nodes))]
        least, own = LEAST * np.einsum("nii->", own) / max(3 * len(nodes), 1), own[table]
        moved, force = np.zeros((len(nodes), 3)), np.zeros(len(rows))
        facet, share, settled = np.zeros(0, int), np.zeros((0, 3)), True
        for iteration in range(MOST):
            corners = (self.points[nodes] + moved)[table]
            nearest = nearest_shares(corners, middle)
            distance, normal = distances(corners, nearest, middle)
            entered = np.flatnonzero(distance < radius - TOLERANCE)
            if len(entered):
                share_of, way = nearest[entered], normal[entered]
                gives = np.einsum("sc,scj,sj->s", share_of**2, np.einsum("si,scij->scj", way, own[entered]), way)
                entered = entered[gives > least]
            if settled and not len(entered):
                break
            facet, share = np.concatenate([facet, entered]), np.concatenate([share, nearest[entered]])
            distance, normal = distances(corners[facet], share, middle)
            lever = np.zeros((len(facet), len(nodes), 3))
            lever[np.arange(len(facet))[:, None], table[facet]] = share[:, :, None] * normal[:, None]
            lever = lever.reshape(len(facet), -1)
            bears = _bearing(lever @ compliance @ lever.T, radius - distance + lever @ moved.ravel())
            force = bears @ lever
            last, moved = moved, (compliance @ force).reshape(-1, 3)
            kept = (bears > 0.0) | (iteration >= FORGETFUL)
            facet, share = facet[kept], share[kept]
            settled = bool(np.abs(moved - last).max() < TOLERANCE)
        out = np.zeros(len(self.compliance))
        out[rows] = force
        return out


def _line(X: np.ndarray, found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The factor (2,), at no depth and what one radius adds, of rows `found` (B, r) that fits `wanted` (B, r) best."""
    depth = np.column_stack([np.ones(len(X)), X[:, 6] / X[:, 7]])
    factor = np.einsum("br,br->b", found, wanted) / np.square(found).sum(axis=1)
    return np.linalg.lstsq(depth, factor, rcond=None)[0]


def _bearing(gain: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The least-energy forces b (i,) >= 0 [N] with gain (i, i) b >= wanted (i,) [m], gain positive semi-definite."""
    gain.flat[:: len(gain) + 1] += APART * np.trace(gain) / len(gain)
    lower, failed = FACTORED(gain, lower=True)
    if failed:
        raise np.linalg.LinAlgError("places that a ball touches do not give way")
    return nnls(lower.T, SOLVED(lower, wanted, lower=True)[0])[0]


def nearest_shares(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Corner coordinates (S, 3) of the places nearest to a point (3,) on triangles with `corners` (S, 3, 3) [m].

    The plane's foot where it lies inside, else the nearest of the three edges (Ericson 2005, "Real-Time Collision
    Detection", section 5.1.5).
    """
    offset, edge = point - corners, corners[:, NEXT] - corners
    along = np.einsum("sci,sci->sc", offset, edge)
    square = np.einsum("sci,sci->sc", edge, edge)
    part = np.clip(along / square, 0.0, 1.0)
    shares = np.zeros((len(corners), 4, 3))
    for corner in range(3):
        shares[:, corner, corner] = 1.0 - part[:, corner]
        shares[:, corner, (corner + 1) % 3] = part[:, corner]
    # Of the foot, from the Gram matrix of the edges a-b and c-a.
    across = np.einsum("si,si->s", edge[:, 0], edge[:, 2])
    toward = -np.einsum("si,si->s", offset[:, 0], edge[:, 2])
    area = square[:, 0] * square[:, 2] - across**2
    v = (square[:, 2] * along[:, 0] + across * toward) / area
    w = (square[:, 0] * toward + across * along[:, 0]) / area
    shares[:, 3] = np.column_stack([1.0 - v - w, v, w])
    away = shares @ corners - point
    far = np.einsum("ski,ski->sk", away, away)
    far[(shares[:, 3] < 0.0).any(axis=1), 3] = np.inf
    return shares[np.arange(len(corners)), far.argmin(axis=1)]


def distances(corners: np.ndarray, share: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far (n,) [m] the places of corner coordinates (n, 3) are from a point (3,), and the directions (n, 3)."""
    away = np.einsum("nc,nci->ni", share, corners) - point
    distance = np.sqrt(np.einsum("ni,ni->n", away, away))
    return distance, away / distance[:, None]
