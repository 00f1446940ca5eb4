"""The finite elements' power series in the force, tabulated over the open cortex: what needs no learning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Self

import numpy as np

from ..array_functions import Rounded, in_chunks, taken

ORDERS = 3
# Which components of the direction are multiplied, order by order: 3, 6 and 10 products.
FACTORS = [np.array(list(combinations_with_replacement(range(3), order))).T for order in range(1, ORDERS + 1)]
# Which of them are each order's.
SPANS = (slice(0, 3), slice(3, 9), slice(9, 19))
TERMS = SPANS[-1].stop
# So many radii carry a parabola.
STENCIL = 3
# What a share of -1 counts for, as a height [m].
BESIDE = 1e-2


def forms(direction: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The products (B, 19) of the components of directions (B, 3), times force^(order - 1) of forces (B,) [N]."""
    columns = [direction[:, FACTORS[0][0]]]
    for order, factors in enumerate(FACTORS[1:], start=1):
        products = direction[:, factors[0]]
        for factor in factors[1:]:
            products = products * direction[:, factor]
        columns.append(products * force[:, None] ** order)
    return np.concatenate(columns, axis=1)


@dataclass(eq=False)
class Series:
    """A regressor that predicts the response to one newton by the first orders of the power series in the force.

    Between tabulated places and radii it interpolates: parabolas on each triangle, and through three radii. In the
    direction every order is a form of its degree, so that the table is exact there.

    Parameters
    ----------
    corners
        (V, 3) [m], of the open cortex.
    triangles
        (S, 6): three corners, then the middles of the edges that lie opposite, as numbers of places.
    radii
        (R,) [m], rising.
    table
        (places R, 19 r): coefficients of the basis's modes.
    """

    corners: np.ndarray
    triangles: np.ndarray
    radii: np.ndarray
    table: Rounded

    @classmethod
    def rounded(
        cls, corners: np.ndarray, triangles: np.ndarray, radii: np.ndarray, table: np.ndarray, step: np.ndarray
    ) -> Self:
        """Round a table (places, R, 19, r) to the steps of its terms (19,)."""
        steps = np.repeat(step, table.shape[-1])
        return cls(corners, triangles, radii, Rounded.of(table.reshape(-1, len(steps)), steps))

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of `tool_features` (B, 8)."""
        return in_chunks(self._predicted, X)

    def _predicted(self, X: np.ndarray) -> np.ndarray:
        place, share = self._located(X[:, :3])
        radius, weight = self._between_radii(X[:, 7])
        count = place.shape[1] * radius.shape[1]
        row = (place[:, :, None] * len(self.radii) + radius[:, None]).reshape(-1, count)
        factor = (share[:, :, None] * weight[:, None]).reshape(-1, 1, count).astype(np.float32)
        mixed = (factor @ taken(row, self.table)).reshape(-1, TERMS, len(self.table.step) // TERMS)
        return (forms(X[:, 3:6], X[:, 6]).astype(np.float32)[:, None] @ mixed)[:, 0]

    def state(self) -> dict[str, np.ndarray]:
        """Places, radii, and the table: whole numbers of steps, `share`, and the step of each column, `unit`."""
        known = {name: getattr(self, name) for name in ("corners", "triangles", "radii")}
        return {**known, "unit": self.table.step, "share": self.table.whole}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """From `state`; files of earlier versions have float16 in place of whole numbers, and more axes."""
        step = state["unit"].ravel()
        table = Rounded(state["share"].reshape(-1, len(step)), step)
        return cls(state["corners"], state["triangles"], state["radii"], table)

    @cached_property
    def _frames(self) -> np.ndarray:
        """(S, 4, 4): from (point, 1) to the shares of a triangle's three corners and the height over it [m]."""
        a, b, c = (self.corners[self.triangles[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        frame = np.zeros((len(a), 4, 4))
        frame[:, :3, 0], frame[:, :3, 1], frame[:, :3, 2], frame[:, :3, 3] = a, b, c, normal
        frame[:, 3, :3] = 1.0
        return np.linalg.inv(frame)

    @cached_property
    def _columns(self) -> np.ndarray:
        """The frames as one matrix (4, 4 S)."""
        return np.ascontiguousarray(self._frames.transpose(2, 1, 0).reshape(4, -1))

    def _located(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Six places (B, 6) of the triangle nearest to each point (B, 3) [m], and their shares of it (B, 6)."""
        local = (point @ self._columns[:3] + self._columns[3]).reshape(-1, 4, len(self.triangles))
        miss = np.absolute(local[:, 3]) - BESIDE * np.minimum(local[:, :3].min(axis=1), 0.0)
        best = miss.argmin(axis=1)
        frame = taken(best, self._frames[:, :3])
        corner = np.maximum(np.einsum("bij,bj->bi", frame[:, :, :3], point) + frame[:, :, 3], 0.0)
        corner = corner / corner.sum(axis=1, keepdims=True)
        share = [corner * (2.0 * corner - 1.0), 4.0 * corner[:, [1, 2, 0]] * corner[:, [2, 0, 1]]]
        return taken(best, self.triangles), np.concatenate(share, axis=1)

    def _between_radii(self, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which radii (B, k), and their weights (B, k): the parabola through the three about each radius (B,) [m]."""
        width = min(STENCIL, len(self.radii))
        inside = np.clip(radius, self.radii[0], self.radii[-1])
        first = np.clip(np.searchsorted(self.radii, inside) - 2, 0, len(self.radii) - width)
        index = first[:, None] + np.arange(width)
        at, x = taken(index, np.log(self.radii)), np.log(inside)[:, None]
        weight = np.ones((1, width))
        for other in range(1, width):
            beside = at[:, np.roll(np.arange(width), other)]
            weight = weight * (x - beside) / (at - beside)
        return index, weight
