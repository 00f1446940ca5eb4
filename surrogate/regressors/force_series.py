"""Power series in the force: table of low orders, pairs of nodal forces, and a Gaussian process for the remainder."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Self

import numpy as np
from scipy.spatial.distance import cdist

from sim.errors import InputError

from ..array_functions import QuantisedTable, find_nonzero_columns, multiply_rows, predict_in_chunks, take_rows
from .gp import Gp

MAX_ORDER = 3  # Order of the power series in the force.
# Indices of the direction components in each product, by order: 3, 6 and 10 products.
FACTORS = [np.array(list(combinations_with_replacement(range(3), order))).T for order in range(1, MAX_ORDER + 1)]
ORDER_COLUMNS = (slice(0, 3), slice(3, 9), slice(9, 19))  # Columns of the products of each order.
TERM_COUNT = ORDER_COLUMNS[-1].stop  # Number of products of all orders.
STENCIL_SIZE = 3  # Number of radii of an interpolating parabola.
HEIGHT_EQUIVALENT = 1e-2  # Height above a triangle that counts like a barycentric coordinate of -1 [m].
SMALL_FORCE_SHARE = (
    0.4  # Share of the largest training force, below which the remainder is smaller than the table's own errors.
)
# Rounding step of the Gaussian process's dual coefficients at the largest force [m]: a third of the file size.
DUAL_STEP = 2e-6
FLAT_TOLERANCE = 1e-6  # Smallest relative spread of positions along a used axis; a flat cortex has two axes.


def compute_direction_monomials(direction: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Compute monomials (B, 19) of direction components (B, 3), times force^(order - 1) of forces (B,) [N]."""
    columns = [direction[:, FACTORS[0][0]]]
    for order, factors in enumerate(FACTORS[1:], start=1):
        products = direction[:, factors[0]]
        for factor in factors[1:]:
            products = products * direction[:, factor]
        columns.append(products * force[:, None] ** order)
    return np.concatenate(columns, axis=1)


@dataclass(eq=False)
class Series:
    """Regressor of the response per newton: the first three orders of the power series in the force, from a table.

    Between tabulated positions and radii it interpolates: quadratically on each triangle, and by parabolas through
    three radii. In the direction, each order is a homogeneous polynomial, which the table represents exactly.

    Parameters
    ----------
    corners
        Vertices (V, 3) [m] of the open cortex.
    triangles
        Triangles (S, 6) as indices of positions: three corners, then the midpoints of the opposite edges.
    radii
        Footprint radii (R,) [m], increasing.
    table
        Coefficients (positions x R, 19 r) of the basis's modes.
    """

    corners: np.ndarray
    triangles: np.ndarray
    radii: np.ndarray
    table: QuantisedTable

    @classmethod
    def quantise_table(
        cls, corners: np.ndarray, triangles: np.ndarray, radii: np.ndarray, table: np.ndarray, step: np.ndarray
    ) -> Self:
        """Build the regressor from a table (positions, R, 19, r), rounded to the steps `step` (19,) of its terms."""
        steps = np.repeat(step, table.shape[-1])
        return cls(corners, triangles, radii, QuantisedTable.quantise(table.reshape(-1, len(steps)), steps))

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, 8) of `compute_tool_features`."""
        return predict_in_chunks(self._compute_prediction, X)

    def _compute_prediction(self, X: np.ndarray) -> np.ndarray:
        place, share = self._locate_points(X[:, :3])
        radius, weight = self._interpolate_radii(X[:, 7])
        count = place.shape[1] * radius.shape[1]
        row = (place[:, :, None] * len(self.radii) + radius[:, None]).reshape(-1, count)
        factor = (share[:, :, None] * weight[:, None]).reshape(-1, 1, count).astype(np.float32)
        mixed = (factor @ take_rows(row, self.table)).reshape(-1, TERM_COUNT, len(self.table.step) // TERM_COUNT)
        return (compute_direction_monomials(X[:, 3:6], X[:, 6]).astype(np.float32)[:, None] @ mixed)[:, 0]

    def state(self) -> dict[str, np.ndarray]:
        """Return corners, triangles, radii, and the table: integers as `share`, step sizes as `unit`."""
        known = {name: getattr(self, name) for name in ("corners", "triangles", "radii")}
        return {**known, "unit": self.table.step, "share": self.table.integers}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild from `state`; older files have float16 instead of integers, and more axes."""
        step = state["unit"].ravel()
        table = QuantisedTable(state["share"].reshape(-1, len(step)), step)
        return cls(state["corners"], state["triangles"], state["radii"], table)

    @cached_property
    def _frames(self) -> np.ndarray:
        """Maps (S, 4, 4) from (point, 1) to barycentric coordinates in each triangle and height above it [m]."""
        a, b, c = (self.corners[self.triangles[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        frame = np.zeros((len(a), 4, 4))
        frame[:, :3, 0], frame[:, :3, 1], frame[:, :3, 2], frame[:, :3, 3] = a, b, c, normal
        frame[:, 3, :3] = 1.0
        return np.linalg.inv(frame)

    @cached_property
    def _columns(self) -> np.ndarray:
        """The maps `_frames` as one matrix (4, 4 S)."""
        return np.ascontiguousarray(self._frames.transpose(2, 1, 0).reshape(4, -1))

    def _locate_points(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the positions (B, 6) of the triangle nearest to each point (B, 3) [m], and their weights (B, 6)."""
        local = (points @ self._columns[:3] + self._columns[3]).reshape(-1, 4, len(self.triangles))
        miss = np.absolute(local[:, 3]) - HEIGHT_EQUIVALENT * np.minimum(local[:, :3].min(axis=1), 0.0)
        best = miss.argmin(axis=1)
        frame = take_rows(best, self._frames[:, :3])
        corner = np.maximum(np.einsum("bij,bj->bi", frame[:, :, :3], points) + frame[:, :, 3], 0.0)
        corner = corner / corner.sum(axis=1, keepdims=True)
        share = [corner * (2.0 * corner - 1.0), 4.0 * corner[:, [1, 2, 0]] * corner[:, [2, 0, 1]]]
        return take_rows(best, self.triangles), np.concatenate(share, axis=1)

    def _interpolate_radii(self, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return indices (B, k) of tabulated radii and parabola weights (B, k) to interpolate at `radii` (B,) [m]."""
        width = min(STENCIL_SIZE, len(self.radii))
        inside = np.clip(radii, self.radii[0], self.radii[-1])
        first = np.clip(np.searchsorted(self.radii, inside) - 2, 0, len(self.radii) - width)
        index = first[:, None] + np.arange(width)
        at, x = take_rows(index, np.log(self.radii)), np.log(inside)[:, None]
        weight = np.ones((1, width))
        for other in range(1, width):
            beside = at[:, np.roll(np.arange(width), other)]
            weight = weight * (x - beside) / (at - beside)
        return index, weight


class RemainderGp:
    """Gaussian process of the response that the series does not represent, in units of force^3 + faint^3.

    The first neglected order is proportional to force^3, so in these units strong and weak loads have equal weight. The
    features are `compute_tool_features` and force over radius, to which indentation is proportional.
    """

    gp_: Gp
    faint_: np.ndarray

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit to features X (n, 8) of `compute_tool_features` and remainders Y (n, r); return the regressor itself."""
        self.faint_ = np.array(SMALL_FORCE_SHARE * X[:, 6].max())
        self.gp_ = Gp().fit(append_force_ratio(X), Y / self._compute_unit(X))
        strongest = X[[X[:, 6].argmax()]]
        step = np.exp2(np.floor(np.log2(DUAL_STEP / (strongest[0, 6] * self._compute_unit(strongest).item()))))
        self.gp_.dual_ = (np.rint(self.gp_.dual_ / step) * step).astype(np.float32)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, 8) of `compute_tool_features`."""
        return (self.gp_.predict(append_force_ratio(X)) * self._compute_unit(X)).astype(np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """Return the Gaussian process's state, and the force `faint` [N]."""
        return {**self.gp_.state(), "faint": self.faint_}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the regressor from the arrays of `state`."""
        model = cls()
        model.faint_ = state["faint"]
        model.gp_ = Gp.restored({name: array for name, array in state.items() if name != "faint"})
        return model

    def _compute_unit(self, X: np.ndarray) -> np.ndarray:
        """Return the unit (n, 1) [N^3] of each row."""
        return X[:, 6:7] ** MAX_ORDER + self.faint_**MAX_ORDER


def append_force_ratio(X: np.ndarray) -> np.ndarray:
    """Append force over radius to the features (n, 8) of `compute_tool_features`; return (n, 9)."""
    return np.column_stack([X, X[:, 6] / X[:, 7]])


@dataclass(frozen=True, eq=False)
class ForcePairs:
    """Regressor of the second order of the response, from the features `compute_root_scaled_forces`.

    Parameters
    ----------
    pairs
        Pairs (P, 2) of indices of force components at the open cortex's nodes.
    table
        Coefficients (P, r) [1/N^2] of the basis's modes for the product of each pair.
    """

    pairs: np.ndarray
    table: QuantisedTable

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, 3 m) of `compute_root_scaled_forces`."""
        return predict_in_chunks(self._compute_prediction, X)

    def _compute_prediction(self, X: np.ndarray) -> np.ndarray:
        used = find_nonzero_columns(X)
        row = self._rows[used[:, None], used]
        row = row[row >= 0]
        first, second = self.pairs[row].T
        return multiply_rows((X[:, first] * X[:, second]).astype(np.float32), self.table, row)

    @cached_property
    def _rows(self) -> np.ndarray:
        """Row (n, n) int32 of `table` for each pair of components; -1 if the pair has no row."""
        out = np.full((self.pairs.max(initial=-1) + 1,) * 2, -1, np.int32)
        out[self.pairs[:, 0], self.pairs[:, 1]] = np.arange(len(self.pairs))
        return out

    def state(self) -> dict[str, np.ndarray]:
        """Return pairs, and the table: integers as `share`, step sizes as `unit`."""
        return {"pairs": self.pairs.astype(np.int32), "unit": self.table.step, "share": self.table.integers}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild from `state`; older files have float16 instead of integers."""
        return cls(state["pairs"], QuantisedTable(state["share"], state["unit"]))


def interpolate_table(points: np.ndarray, table: np.ndarray, held_out: np.ndarray) -> np.ndarray:
    """Replace a table's rows at `held_out` positions by interpolation from the other positions; return the table.

    Cubic radial basis functions with a linear polynomial are used (Duchon 1977, "Splines minimizing rotation-invariant
    semi-norms"), which reproduce fields that are linear in position.

    Parameters
    ----------
    points
        Positions (P, 3) [m].
    table
        Table (P, ...) in any unit.
    held_out
        Mask (P,) bool of held-out positions.

    Raises
    ------
    InputError
        All positions are held out.
    """
    if not held_out.any():
        return table
    if held_out.all():
        raise InputError(
            "the discs left out hold all places of the cortex at which the finite elements were asked, so that nothing "
            "is known outside: leave out fewer or smaller discs."
        )
    known = points[~held_out]
    middle, length = known.mean(axis=0), np.ptp(points, axis=0).max()
    _, size, axes = np.linalg.svd(known - middle, full_matrices=False)
    axes = axes[size > FLAT_TOLERANCE * max(size[0], np.finfo(float).tiny)]

    def build_kernel(sites: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tail = np.column_stack([np.ones(len(sites)), (sites - middle) @ axes.T / length])
        return (cdist(sites, known) / length) ** 3, tail

    kernel, tail = build_kernel(known)
    corner = np.zeros((tail.shape[1], tail.shape[1]))
    matrix = np.block([[kernel, tail], [tail.T, corner]])
    weights = np.linalg.solve(matrix, np.hstack(build_kernel(points[held_out])).T)[: len(known)].T
    out = table.copy()
    out[held_out] = (weights @ table[~held_out].reshape(len(known), -1)).reshape(-1, *table.shape[1:])
    return out
