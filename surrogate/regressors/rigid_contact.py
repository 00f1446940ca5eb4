"""A rigid tool on linear tissue: what needs no learning where the tool's pose is known.

The body is condensed to the nodes that a tool may touch: u = C f, C their compliance at rest. Of all frictionless
forces that keep the tool out of every facet it bears those of least energy f.Cf / 2 (Signorini's problem). A tool is
all within a radius of a point, a line or a rectangle, and enters a flat facet first where that is nearest. So
constraints are added where a facet is entered, until none is (the exchange method: Hettich, Kortanek 1993,
"Semi-infinite programming", SIAM Rev. 35:380-429). Each is linearised where its point has come to: a distance from
something convex is convex, so that what satisfies the linear ones satisfies all. Their multipliers are a nonnegative
least-squares problem (Lawson, Hanson 1974, "Solving Least Squares Problems", chapter 23). Stiffness cancels: how stiff
tissue is need not be known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.optimize import nnls

from sim.effects import ToolContact
from sim.geometry.closest_point import bounding_balls
from sim.runtime.threads import one_thread
from sim.tools import Ball

if TYPE_CHECKING:
    from sim.discretisation.nearest_places import Placed

# Finite elements keep tissue within a gap of the ball [m]: on average half of it.
THICKER = 0.5 * ToolContact((Ball(1.0),)).gap
# Facets within so many radii of what a tool lies round may come to touch.
REACH = 1.5
# A facet entered by less [m], and motions smaller than so many times that, end the search, which so many rounds bound.
TOLERANCE, SETTLED, MOST = 1e-6, 3.0, 60
# A rod or a blade goes in by so many radii at once, so that tissue stays before it; there a facet is entered by more.
STRIDE, COARSER = 0.5, 1e-5
# Where it only goes through, so many rounds do: more change the answer by less than what it is off, in twice the time.
PASSING = 3
# So many places that bear a force are known of a tool that goes on: the strongest.
MOST_HELD = 128
# Constraints that bear nothing are dropped, which is faster; after so many rounds they stay: nothing goes in circles.
FORGETFUL = 15
# Places that give less than this share of what nodes do on average are bone's, which the tool enters: no force, or one
# beyond all bounds, would keep it out.
LEAST = 0.02
# Straight from LAPACK: the problems are so small that a wrapper takes longer than the work.
FACTORED, SOLVED_BY, SOLVED = get_lapack_funcs(("potrf", "trtrs", "posv"), dtype=np.float64)
# Places are let go and taken up again so often at most; one that is let go may be entered by so much [m].
TURNS, ENTERED = 10, 1e-8
# Points of neighbouring facets on a common edge are one: of the mean diagonal, so that their forces are distinct. The
# first that makes single precision positive definite.
APART = (1e-6, 1e-5, 1e-4)
# Features of a ball, and of a rod or a blade.
LYING, STANDING = 8, 17


@dataclass(eq=False)
class Contact:
    """A regressor that predicts the response to one metre of indentation.

    It is given `tool_features` of a ball, and `core_features` of a rod or a blade. Behind those may stand what
    `held` gave where the rod or blade stood last: it then goes on from there, which takes a fraction of the time.

    What nonlinearity adds far from the tool is nearly a factor of the force, that grows with depth over radius: a line,
    which is all that is learned. Where tissue relaxes there is another line, in proportion to the share that is gone.

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
        (2, r): at no depth, and what a depth of one radius adds. (4, r): then what both add once all has relaxed.
    grip
        (2,) or (4,): the same factor of the force that the tool exerts; (0,) where none was learned.
    core
        (4,) [m]: half sizes of what a rod or a blade lies round, and its radius. (0,): a ball, its radius a feature.
    """

    points: np.ndarray
    triangles: np.ndarray
    compliance: np.ndarray
    answers: np.ndarray
    line: np.ndarray
    grip: np.ndarray = field(default_factory=lambda: np.zeros(0))
    core: np.ndarray = field(default_factory=lambda: np.zeros(0))
    # Features that were last asked for, and what was found: motion and reaction of one load are had from one search.
    _last: tuple[bytes, np.ndarray] = field(default=(b"", np.zeros(0)), init=False, repr=False)

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of features (B, f), whose force is depth [m]."""
        found = self.linear(X)
        return (found * (self._terms(X)[:, : len(self.line)] @ self.line)).astype(np.float32)

    def linear(self, X: np.ndarray) -> np.ndarray:
        """The same (B, r) of tissue that is linear."""
        return self.force(X).astype(np.float32) @ self.answers / np.maximum(X[:, 6:7], np.finfo(np.float32).tiny)

    def exerted(self, X: np.ndarray) -> np.ndarray:
        """The force (B, 3) [N/m] that the tool exerts, by one metre of depth; `grip` must have been learned."""
        return self._resultant(X) * (self._terms(X) @ self.grip)[:, None]

    @property
    def held_width(self) -> int:
        """How many numbers `held` has a row."""
        return self._width + len(self.compliance) + 4 * MOST_HELD

    def held(self, X: np.ndarray) -> np.ndarray:
        """Where rods or blades stand, what they exert, and where (B, h): what the next pose may go on from."""
        return np.hstack([X[:, : self._width], self._found(X)])

    def held_force(self, held: np.ndarray) -> np.ndarray:
        """The forces (B, 3 k) [N] in rows of `held`."""
        return held[:, self._width : self._width + len(self.compliance)]

    def _terms(self, X: np.ndarray) -> np.ndarray:
        """What lines are of (B, 2), or of tissue that relaxes (B, 4)."""
        depth, relaxed = np.column_stack([np.ones(len(X)), X[:, 6] / X[:, 7]]), self._parted(X)[1]
        return np.hstack([depth, relaxed * depth]) if relaxed.shape[1] else depth

    def _parted(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of features: how the tool stands, how far tissue has relaxed, and what was `held`: both may be none."""
        more = X[:, self._width :]
        relaxed, held = np.split(more, [more.shape[1] % self.held_width], axis=1)
        return X[:, : self._width], relaxed, held

    @property
    def _width(self) -> int:
        """How many features say where the tool stands."""
        return STANDING if len(self.core) else LYING

    def _resultant(self, X: np.ndarray) -> np.ndarray:
        """The same (B, 3) of tissue that is linear."""
        whole = self.force(X).reshape(len(X), -1, 3).sum(axis=1)
        return whole / np.maximum(X[:, 6:7], np.finfo(np.float32).tiny)

    def force(self, X: np.ndarray) -> np.ndarray:
        """What the tool does to linear tissue at the nodes that it may touch (B, 3 k) [N]."""
        return self._found(X)[:, : len(self.compliance)]

    def _found(self, X: np.ndarray) -> np.ndarray:
        """Forces (B, 3 k) [N], and then triangles and corner coordinates (4,) of the places that bear them, or -1."""
        stands, _, held = self._parted(X)
        X = np.ascontiguousarray(np.hstack([stands, held]))
        asked, (known, found) = X.tobytes(), self._last
        if asked == known:
            return found
        out = np.zeros((len(X), len(self.compliance) + 4 * MOST_HELD))
        with one_thread():
            for row in np.flatnonzero(X[:, 6] > 0.0):
                out[row] = self._pressed(*self._way(X[row]))
        out.flags.writeable = False
        self._last = asked, out
        return out

    def fitted(self, X: np.ndarray, Y: np.ndarray, alike: np.ndarray, exerted: np.ndarray | None = None) -> Self:
        """With the lines that fit coefficients Y (B, r) best; `alike` (r,) numbers those that share one.

        `exerted` (B, 3) [N/m] is the tool's force by one metre of depth, where it is known.
        """
        found, terms = self.linear(X), self._terms(X)
        line = np.zeros((terms.shape[1], found.shape[1]))
        for each in np.unique(alike):
            mine = alike == each
            line[:, mine] = _line(terms, found[:, mine], Y[:, mine])[:, None]
        grip = self.grip if exerted is None else _line(terms, self._resultant(X), exerted)
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

    def _way(self, x: np.ndarray) -> tuple[list[Placed], float, np.ndarray | None]:
        """Where the tool of a row of features goes through, its radius [m], and a row of `_found`, or None.

        The first place is where it stood last, if that is nearer than where it came in; then the row is what was found
        there. Else it is the first on the way in.
        """
        # Warp is loaded where a tool is pressed, not where a model is read.
        from sim.discretisation.nearest_places import Placed

        point, direction, depth, radius = x[:3], x[3:6], x[6], x[7]
        if not len(self.core):
            return [Placed(point + (depth - radius) * direction, np.eye(3), np.zeros(3))], radius + THICKER, None
        there, stride = self._standing(x), STRIDE * self.core[3]
        steps, last = int(np.ceil(depth / stride)), x[self._width :]
        if len(last) and last[6] > 0.0:
            begun = self._standing(last)
            far = np.linalg.norm(there.corners - begun.corners, axis=1).max()
            if (few := int(np.ceil(far / stride))) < steps:
                back = begun.middle - there.middle
                ways = [there.moved((1.0 - k / few) * back) for k in range(1, few + 1)] or [there]
                return [begun, *ways], self.core[3] + THICKER, last[self._width :]
        ways = [(k / steps - 1.0) * depth * direction for k in range(1, steps + 1)]
        return [there.moved(way) for way in ways], self.core[3] + THICKER, None

    def _standing(self, x: np.ndarray) -> Placed:
        from sim.discretisation.nearest_places import Placed

        axes = np.column_stack([x[11:14], np.cross(x[14:17], x[11:14]), x[14:17]])
        return Placed(x[8:11], axes, self.core[:3])

    def _pressed(self, stations: list[Placed], radius: float, begun: np.ndarray | None) -> np.ndarray:
        """Of a tool of a radius [m] at the last of the stations that it goes through: a row of `_found`.

        begun is that of the first of them; None: nothing is touched before.
        """
        from sim.discretisation.nearest_places import Nearest

        facets, nodes, table, rows = self._touchable(stations, radius)
        nearest = Nearest(len(facets))
        compliance = self.compliance[np.ix_(rows, rows)].astype(np.float64)
        own = compliance.reshape(len(nodes), 3, len(nodes), 3)[np.arange(len(nodes)), :, np.arange(len(nodes))]
        least, own = LEAST * np.einsum("nii->", own) / max(3 * len(nodes), 1), own[table]
        tolerance = COARSER if len(self.core) else TOLERANCE
        moved, force = np.zeros((len(nodes), 3)), np.zeros(len(rows))
        facet, share, bears = np.zeros(0, int), np.zeros((0, 3)), np.zeros(0)
        if begun is not None:
            stations, moved = stations[1:], (compliance @ begun[rows]).reshape(-1, 3)
            places = begun[len(self.compliance) :].reshape(MOST_HELD, 4)
            places = places[np.isin(places[:, 0], facets)]
            facet, share = np.searchsorted(facets, places[:, 0]), places[:, 1:]
        for station in stations:
            settled = begun is None
            for iteration in range(MOST if station is stations[-1] else PASSING):
                corners = (self.points[nodes] + moved)[table]
                near = nearest.to(station, corners)
                entered = np.flatnonzero(near.distance < radius - tolerance)
                if len(entered):
                    share_of, way = near.share[entered], near.normal[entered]
                    gives = np.einsum("sc,scj,sj->s", share_of**2, np.einsum("si,scij->scj", way, own[entered]), way)
                    entered = entered[gives > least]
                if settled and not len(entered):
                    break
                facet, share = np.concatenate([facet, entered]), np.concatenate([share, near.share[entered]])
                distance, normal = station.distances(corners[facet], share)
                lever = np.zeros((len(facet), len(nodes), 3))
                lever[np.arange(len(facet))[:, None], table[facet]] = share[:, :, None] * normal[:, None]
                lever = lever.reshape(len(facet), -1)
                bears = _bearing(lever @ compliance @ lever.T, radius - distance + lever @ moved.ravel())
                force = bears @ lever
                last, moved = moved, (compliance @ force).reshape(-1, 3)
                kept = (bears > 0.0) | (iteration >= FORGETFUL)
                facet, share, bears = facet[kept], share[kept], bears[kept]
                settled = bool(np.abs(moved - last).max() < SETTLED * tolerance)
        whole, places = np.zeros(len(self.compliance)), np.full((MOST_HELD, 4), -1.0)
        whole[rows] = force
        strongest = np.argsort(-bears)[:MOST_HELD]
        places[: len(strongest)] = np.column_stack([facets[facet], share])[strongest]
        return np.concatenate([whole, places.ravel()])

    def _touchable(
        self, stations: list[Placed], radius: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Facets (S,) that a tool may touch; their nodes (n,), positions there (S, 3), and rows of the compliance."""
        around, wide = self._rounds
        reach = REACH * radius
        far = wide + reach + np.linalg.norm(stations[0].half)
        ends = [stations[k] for k in sorted({0, len(stations) // 2, len(stations) - 1})]
        some = np.flatnonzero(np.any([np.linalg.norm(around - each.middle, axis=1) < far for each in ends], axis=0))
        corners = self.points[self.triangles[some]]
        near = np.any([each.nearest(corners).distance < reach for each in ends], axis=0)
        nodes, table = np.unique(self.triangles[some[near]], return_inverse=True)
        return some[near], nodes, table, (3 * nodes[:, None] + np.arange(3)).ravel()


def _line(terms: np.ndarray, found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The factor (k,), a sum of terms (B, k), of rows `found` (B, r) that fits `wanted` (B, r) best."""
    factor = np.einsum("br,br->b", found, wanted) / np.square(found).sum(axis=1)
    return np.linalg.lstsq(terms, factor, rcond=None)[0]


def _bearing(gain: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The least-energy forces b (i,) >= 0 [N] with gain (i, i) b >= wanted (i,) [m], gain positive semi-definite.

    Most places bear a force as before. Those that would pull are let go. Those that are entered then are taken up
    again, until neither is left. Where that does not end soon it is a nonnegative least-squares problem. (Portugal,
    Judice, Vicente 1994, "A comparison of block pivoting and interior-point algorithms for linear least squares
    problems with nonnegative variables", Math. Comput. 63:625-643.)
    """
    count = len(gain)
    if not count:
        return wanted
    mean = np.trace(gain) / count
    for apart in APART:
        firm = gain + apart * mean * np.eye(count)
        bearing = np.ones(count, bool)
        for _ in range(TURNS):
            free, bears = np.flatnonzero(bearing), np.zeros(count)
            _, bears[free], failed = SOLVED(firm[np.ix_(free, free)], wanted[free])
            if failed:
                break
            wrong = np.where(bearing, bears < 0.0, wanted - firm @ bears > ENTERED)
            if not wrong.any():
                return bears
            bearing ^= wrong
            if not bearing.any():
                break
        lower, failed = FACTORED(firm, lower=True)
        if not failed:
            return nnls(lower.T, SOLVED_BY(lower, wanted, lower=True)[0])[0]
    raise np.linalg.LinAlgError("places that a tool touches do not give way")
