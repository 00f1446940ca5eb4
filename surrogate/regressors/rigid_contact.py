"""Contact of a rigid tool with linear tissue: a model for known tool poses that needs almost no training.

The body is condensed to the nodes that a tool may touch: u = C f, with the compliance C of the undeformed body. Of all
frictionless forces that keep the tool out of every facet, the solution has the least energy f.Cf / 2 (Signorini's
problem). A tool consists of all points within a radius of a point, a line or a rectangle. It penetrates a flat facet
first at the facet's nearest point, so each penetrated facet adds a constraint, until none is penetrated (the exchange
method: Hettich, Kortanek 1993, "Semi-infinite programming", SIAM Rev. 35:380-429). Constraints are linearised at the
points' present positions. The distance from a convex set is convex, so a solution of the linear constraints satisfies
all. The multipliers solve a nonnegative least-squares problem (Lawson, Hanson 1974, "Solving Least Squares Problems",
chapter 23). The tissue's stiffness cancels out and need not be known.
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
from sim.geometry.closest_point import compute_bounding_balls
from sim.runtime.threads import limit_to_one_thread
from sim.tools import Ball

if TYPE_CHECKING:
    from sim.discretisation.nearest_points import PlacedBox

MEAN_GAP = 0.5 * ToolContact((Ball(1.0),)).gap  # Mean gap that FEM keeps between tissue and tool [m].
MAX_STORED_POINTS = 128  # Maximum number of contact points stored for a warm start: the strongest.
# LAPACK's factorisation and solves: the problems are so small that a wrapper takes longer than the work.
FACTORISE, SOLVE_TRIANGULAR, SOLVE_POSITIVE = get_lapack_funcs(("potrf", "trtrs", "posv"), dtype=np.float64)
BALL_FEATURES = 8  # Number of features of a ball.
ROD_FEATURES = 17  # Number of features of a rod or a blade.


@dataclass(frozen=True)
class ContactSearchSettings:
    """Settings of the search for contact points in `RigidContact`."""

    candidate_distance: float = 1.5  # Distance from the tool's core up to which facets are contact candidates [radii].
    ball_tolerance: float = 1e-6  # Penetration tolerance of a ball [m].
    rod_tolerance: float = 1e-5  # Penetration tolerance of a rod or a blade [m].
    min_search_motion: float = 3.0  # Smallest nodal motion that continues the contact search [tolerances].
    max_iterations: int = 60  # Maximum number of iterations of the contact search.
    path_step: float = 0.5  # Step of a rod or a blade on its path [radii], so that tissue stays in front of it.
    # Number of iterations at intermediate steps: more change the result by less than its error, in twice the time.
    path_iterations: int = 3
    # Number of iterations after which constraints without force are kept, to prevent cycles. Until then they are
    # dropped, which is faster.
    dropping_iterations: int = 15
    # Compliance of a point, relative to the nodes' mean, below which it is bone. A tool may enter bone, as no force,
    # or an unbounded one, would prevent that.
    min_compliance: float = 0.02
    max_exchanges: int = 10  # Maximum number of exchanges of the active set.
    inactive_tolerance: float = 1e-8  # Penetration of an inactive point that is tolerated [m].
    # Candidate regularisations relative to the mean diagonal, as points of neighbouring facets on a common edge
    # coincide. The first one that gives a positive definite matrix in single precision is used.
    regularisations: tuple[float, float, float] = (1e-6, 1e-5, 1e-4)


SEARCH = ContactSearchSettings()


@dataclass(eq=False)
class RigidContact:
    """Regressor of the response to an indentation, per metre of depth.

    Its input is `compute_tool_features` of a ball, or `compute_core_features` of a rod or a blade. The latter may be
    followed by `compute_warm_start` of the previous pose: the search then starts from that contact, which takes a
    fraction of the time.

    Far from the tool, nonlinearity acts nearly as a factor on the force. This factor is a line in depth over radius,
    which is fitted. For relaxing tissue a second line is added, in proportion to the relaxed share.

    Parameters
    ----------
    points
        Positions (k, 3) [m] of the nodes that a tool may touch.
    triangles
        Triangles (S, 3) as indices into `points`.
    compliance
        Compliance matrix (3 k, 3 k) [m/N] float32.
    answers
        Coefficients (3 k, r) [1/N] float32 of the basis's modes for unit forces on the nodes.
    line
        Factor (2, r): value at depth 0, and slope per depth / radius; (4, r): then the change of both on relaxation.
    grip
        Factor (2,) or (4,) on the tool's force, as `line`; (0,) if not fitted.
    core
        Half sizes of a rod's or blade's core, and its radius (4,) [m]; (0,) for a ball, whose radius is a feature.
    """

    points: np.ndarray
    triangles: np.ndarray
    compliance: np.ndarray
    answers: np.ndarray
    line: np.ndarray
    grip: np.ndarray = field(default_factory=lambda: np.zeros(0))
    core: np.ndarray = field(default_factory=lambda: np.zeros(0))
    # Last features and their contact, so that motion and reaction of a load need only one search.
    _last: tuple[bytes, np.ndarray] = field(default=(b"", np.zeros(0)), init=False, repr=False)

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, f), which contain a depth [m] instead of a force."""
        found = self.compute_linear(X)
        return (found * (self._compute_terms(X)[:, : len(self.line)] @ self.line)).astype(np.float32)

    def compute_linear(self, X: np.ndarray) -> np.ndarray:
        """Compute the coefficients (B, r) for linear tissue, per metre of depth."""
        force = self.compute_nodal_forces(X).astype(np.float32)
        return force @ self.answers / np.maximum(X[:, 6:7], np.finfo(np.float32).tiny)

    def predict_force(self, X: np.ndarray) -> np.ndarray:
        """Predict the tool's force (B, 3) [N/m] on the tissue per metre of depth; requires a fitted `grip`."""
        return self._compute_resultant(X) * (self._compute_terms(X) @ self.grip)[:, None]

    @property
    def warm_start_width(self) -> int:
        """Number of columns of `compute_warm_start`."""
        return self._pose_feature_count + len(self.compliance) + 4 * MAX_STORED_POINTS

    def compute_warm_start(self, X: np.ndarray) -> np.ndarray:
        """Return a warm start (B, h) for the next pose: features, nodal forces and contact points."""
        return np.hstack([X[:, : self._pose_feature_count], self._find_contact(X)])

    def get_warm_start_force(self, warm_start: np.ndarray) -> np.ndarray:
        """Return the nodal forces (B, 3 k) [N] in the rows of `warm_start`."""
        return warm_start[:, self._pose_feature_count : self._pose_feature_count + len(self.compliance)]

    def _compute_terms(self, X: np.ndarray) -> np.ndarray:
        """Compute the terms (B, 2) of the factor's line: 1 and depth / radius; (B, 4) for relaxing tissue."""
        depth, relaxed = np.column_stack([np.ones(len(X)), X[:, 6] / X[:, 7]]), self._split_features(X)[1]
        return np.hstack([depth, relaxed * depth]) if relaxed.shape[1] else depth

    def _split_features(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split features into tool pose, relaxed share and warm start; the last two may have no columns."""
        more = X[:, self._pose_feature_count :]
        relaxed, held = np.split(more, [more.shape[1] % self.warm_start_width], axis=1)
        return X[:, : self._pose_feature_count], relaxed, held

    @property
    def _pose_feature_count(self) -> int:
        """Number of features of the tool's pose."""
        return ROD_FEATURES if len(self.core) else BALL_FEATURES

    def _compute_resultant(self, X: np.ndarray) -> np.ndarray:
        """Compute the tool's force (B, 3) [N/m] on linear tissue, per metre of depth."""
        whole = self.compute_nodal_forces(X).reshape(len(X), -1, 3).sum(axis=1)
        return whole / np.maximum(X[:, 6:7], np.finfo(np.float32).tiny)

    def compute_nodal_forces(self, X: np.ndarray) -> np.ndarray:
        """Compute the tool's nodal forces (B, 3 k) [N] on linear tissue."""
        return self._find_contact(X)[:, : len(self.compliance)]

    def _find_contact(self, X: np.ndarray) -> np.ndarray:
        """Compute nodal forces (B, 3 k) [N], then contact points: triangle, barycentric coordinates; -1 if none."""
        stands, _, held = self._split_features(X)
        X = np.ascontiguousarray(np.hstack([stands, held]))
        asked, (known, found) = X.tobytes(), self._last
        if asked == known:
            return found
        out = np.zeros((len(X), len(self.compliance) + 4 * MAX_STORED_POINTS))
        with limit_to_one_thread():
            for row in np.flatnonzero(X[:, 6] > 0.0):
                out[row] = self._solve_contact(*self._compute_path(X[row]))
        out.flags.writeable = False
        self._last = asked, out
        return out

    def fit_lines(
        self, X: np.ndarray, Y: np.ndarray, column_groups: np.ndarray, tool_force: np.ndarray | None = None
    ) -> Self:
        """Fit the lines to coefficients Y (B, r); columns with the same number in `column_groups` (r,) share a line.

        `tool_force` (B, 3) [N/m] is the tool's force per metre of depth; None: `grip` is not changed.
        """
        found, terms = self.compute_linear(X), self._compute_terms(X)
        line = np.zeros((terms.shape[1], found.shape[1]))
        for each in np.unique(column_groups):
            mine = column_groups == each
            line[:, mine] = _fit_line(terms, found[:, mine], Y[:, mine])[:, None]
        grip = self.grip if tool_force is None else _fit_line(terms, self._compute_resultant(X), tool_force)
        return replace(self, line=line, grip=grip)

    def state(self) -> dict[str, np.ndarray]:
        """Return all fields as arrays by name."""
        return {item.name: getattr(self, item.name) for item in fields(self) if item.init}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the regressor from the arrays of `state`."""
        return cls(**state)

    @cached_property
    def _bounding_balls(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (S, 3) [m] and radii (S,) [m] of the triangles' bounding balls."""
        return compute_bounding_balls(self.points[self.triangles])

    def _compute_path(self, x: np.ndarray) -> tuple[list[PlacedBox], float, np.ndarray | None]:
        """Compute a tool's path for a row of features; return the path, the contact radius [m] and the start's contact.

        If the previous pose is nearer than the first contact, the path starts there, and the start's contact is its row
        of `_find_contact`. Else the path starts at the first step of the approach, and the start's contact is None.
        """
        # Warp is imported only for pressing tools, not for reading a model.
        from sim.discretisation.nearest_points import PlacedBox

        point, direction, depth, radius = x[:3], x[3:6], x[6], x[7]
        if not len(self.core):
            return [PlacedBox(point + (depth - radius) * direction, np.eye(3), np.zeros(3))], radius + MEAN_GAP, None
        there, stride = self._place_box(x), SEARCH.path_step * self.core[3]
        steps, last = int(np.ceil(depth / stride)), x[self._pose_feature_count :]
        if len(last) and last[6] > 0.0:
            begun = self._place_box(last)
            far = np.linalg.norm(there.corners - begun.corners, axis=1).max()
            if (few := int(np.ceil(far / stride))) < steps:
                back = begun.centre - there.centre
                ways = [there.move((1.0 - k / few) * back) for k in range(1, few + 1)] or [there]
                return [begun, *ways], self.core[3] + MEAN_GAP, last[self._pose_feature_count :]
        ways = [(k / steps - 1.0) * depth * direction for k in range(1, steps + 1)]
        return [there.move(way) for way in ways], self.core[3] + MEAN_GAP, None

    def _place_box(self, x: np.ndarray) -> PlacedBox:
        from sim.discretisation.nearest_points import PlacedBox

        axes = np.column_stack([x[11:14], np.cross(x[14:17], x[11:14]), x[14:17]])
        return PlacedBox(x[8:11], axes, self.core[:3])

    def _solve_contact(self, stations: list[PlacedBox], radius: float, initial: np.ndarray | None) -> np.ndarray:
        """Solve the contact of a tool of `radius` [m] at the last station of its path; return a row of `_find_contact`.

        `initial` is the contact at the first station; None: the path starts without contact.
        """
        from sim.discretisation.nearest_points import NearestSearch

        facets, nodes, table, rows = self._select_facets(stations, radius)
        nearest = NearestSearch(len(facets))
        compliance = self.compliance[np.ix_(rows, rows)].astype(np.float64)
        own = compliance.reshape(len(nodes), 3, len(nodes), 3)[np.arange(len(nodes)), :, np.arange(len(nodes))]
        least, own = SEARCH.min_compliance * np.einsum("nii->", own) / max(3 * len(nodes), 1), own[table]
        tolerance = SEARCH.rod_tolerance if len(self.core) else SEARCH.ball_tolerance
        moved, force = np.zeros((len(nodes), 3)), np.zeros(len(rows))
        facet, share, bears = np.zeros(0, int), np.zeros((0, 3)), np.zeros(0)
        if initial is not None:
            stations, moved = stations[1:], (compliance @ initial[rows]).reshape(-1, 3)
            places = initial[len(self.compliance) :].reshape(MAX_STORED_POINTS, 4)
            places = places[np.isin(places[:, 0], facets)]
            facet, share = np.searchsorted(facets, places[:, 0]), places[:, 1:]
        for station in stations:
            settled = initial is None
            for iteration in range(SEARCH.max_iterations if station is stations[-1] else SEARCH.path_iterations):
                corners = (self.points[nodes] + moved)[table]
                near = nearest.find_nearest(station, corners)
                entered = np.flatnonzero(near.distance < radius - tolerance)
                if len(entered):
                    share_of, way = near.barycentric[entered], near.normal[entered]
                    gives = np.einsum("sc,scj,sj->s", share_of**2, np.einsum("si,scij->scj", way, own[entered]), way)
                    entered = entered[gives > least]
                if settled and not len(entered):
                    break
                facet, share = np.concatenate([facet, entered]), np.concatenate([share, near.barycentric[entered]])
                distance, normal = station.compute_distances(corners[facet], share)
                lever = np.zeros((len(facet), len(nodes), 3))
                lever[np.arange(len(facet))[:, None], table[facet]] = share[:, :, None] * normal[:, None]
                lever = lever.reshape(len(facet), -1)
                bears = _compute_bearing_forces(lever @ compliance @ lever.T, radius - distance + lever @ moved.ravel())
                force = bears @ lever
                last, moved = moved, (compliance @ force).reshape(-1, 3)
                kept = (bears > 0.0) | (iteration >= SEARCH.dropping_iterations)
                facet, share, bears = facet[kept], share[kept], bears[kept]
                settled = bool(np.abs(moved - last).max() < SEARCH.min_search_motion * tolerance)
        whole, places = np.zeros(len(self.compliance)), np.full((MAX_STORED_POINTS, 4), -1.0)
        whole[rows] = force
        strongest = np.argsort(-bears)[:MAX_STORED_POINTS]
        places[: len(strongest)] = np.column_stack([facets[facet], share])[strongest]
        return np.concatenate([whole, places.ravel()])

    def _select_facets(
        self, stations: list[PlacedBox], radius: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Select facets (S,) within a tool's reach; return facets, nodes (n,), node indices (S, 3), compliance rows."""
        around, wide = self._bounding_balls
        reach = SEARCH.candidate_distance * radius
        far = wide + reach + np.linalg.norm(stations[0].half_sizes)
        ends = [stations[k] for k in sorted({0, len(stations) // 2, len(stations) - 1})]
        some = np.flatnonzero(np.any([np.linalg.norm(around - each.centre, axis=1) < far for each in ends], axis=0))
        corners = self.points[self.triangles[some]]
        near = np.any([each.find_nearest(corners).distance < reach for each in ends], axis=0)
        nodes, table = np.unique(self.triangles[some[near]], return_inverse=True)
        return some[near], nodes, table, (3 * nodes[:, None] + np.arange(3)).ravel()


def _fit_line(terms: np.ndarray, predicted: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Fit coefficients (k,) of terms (B, k) whose sum is the factor that scales `predicted` to `targets` (B, r)."""
    factor = np.einsum("br,br->b", predicted, targets) / np.square(predicted).sum(axis=1)
    return np.linalg.lstsq(terms, factor, rcond=None)[0]


def _compute_bearing_forces(gain: np.ndarray, penetration: np.ndarray) -> np.ndarray:
    """Compute the least-energy forces b (i,) >= 0 [N] with gain (i, i) b >= wanted (i,) [m]; gain is semi-definite.

    Block pivoting: most points remain active. Points with tension are released, and released points that are penetrated
    become active again, until there are neither. If this takes too long, a nonnegative least-squares problem is solved.
    (Portugal, Judice, Vicente 1994, "A comparison of block pivoting and interior-point algorithms for linear least
    squares problems with nonnegative variables", Math. Comput. 63:625-643.)
    """
    count = len(gain)
    if not count:
        return penetration
    mean = np.trace(gain) / count
    for apart in SEARCH.regularisations:
        firm = gain + apart * mean * np.eye(count)
        bearing = np.ones(count, bool)
        for _ in range(SEARCH.max_exchanges):
            free, bears = np.flatnonzero(bearing), np.zeros(count)
            _, bears[free], failed = SOLVE_POSITIVE(firm[np.ix_(free, free)], penetration[free])
            if failed:
                break
            wrong = np.where(bearing, bears < 0.0, penetration - firm @ bears > SEARCH.inactive_tolerance)
            if not wrong.any():
                return bears
            bearing ^= wrong
            if not bearing.any():
                break
        lower, failed = FACTORISE(firm, lower=True)
        if not failed:
            return nnls(lower.T, SOLVE_TRIANGULAR(lower, penetration, lower=True)[0])[0]
    raise np.linalg.LinAlgError("places that a tool touches do not give way")
