"""Each regressor's prediction as wires, from what it stores."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..regressors.ann import Ann
from ..regressors.compliance_table import Linear
from ..regressors.force_series import BESIDE, FACTORS, ORDERS, STENCIL, TERMS, Series
from ..regressors.gp import Gp
from ..regressors.pcr import Pcr
from ..regressors.protocol import Fitted
from ..regressors.series_residual import Remainder
from ..regressors.svr import Svr
from .graph import Wire

State = Mapping[str, np.ndarray]


def _linear(X: Wire, state: State) -> Wire:
    return X @ state["compliance"]


def _pcr(X: Wire, state: State) -> Wire:
    return (X - state["mean"]) @ state["map"] + state["offset"]


def _ann(X: Wire, state: State) -> Wire:
    x = (X - state["mean"]) / state["deviation"]
    last = sum(name.startswith("weight") for name in state) - 1
    for layer in range(last):
        x = (x @ state[f"weight{layer}"] + state[f"bias{layer}"]).through("Tanh")
    return (x @ state[f"weight{last}"] + state[f"bias{last}"]) * state["scale"] + state["offset"]


def _svr(X: Wire, state: State) -> Wire:
    squared = squares_between((X.of(np.float64) - state["mean"]) / state["deviation"], state["support"])
    near = (squared / -float(len(state["mean"]))).through("Exp")
    # Under a large penalty this sum is a thousandth of its terms and less: it stays in double precision.
    return (near @ state["dual"] + state["intercept"]).of(np.float32)


def _gp(X: Wire, state: State) -> Wire:
    x = (X.of(np.float64) - state["mean"]) / (state["deviation"] * state["length"])
    s = np.sqrt(5.0) * squares_between(x, state["seen"]).through("Sqrt")
    near = (1.0 + s + s * s / 3.0) * (-1.0 * s).through("Exp")
    # Where little noise was found, this sum is a thousandth of its terms and less: it stays in double precision.
    return (near @ state["dual"] + state["offset"]).of(np.float32)


def _remainder(X: Wire, state: State) -> Wire:
    force, radius = X.columns(6), X.columns(7)
    unit = force.through("Pow", float(ORDERS)) + state["faint"] ** ORDERS
    return _gp(X.sheet.joined(X, force / radius), state) * unit


def _series(X: Wire, state: State) -> Wire:
    series = Series.restored(state)
    place, share = _located(X.columns(0, 1, 2), series.frames, series.triangles)
    radius, weight = _between_radii(X.columns(7), series.radii)
    row = place.shaped(0, -1, 1) * len(series.radii) + radius.shaped(0, 1, -1)
    factor = share.shaped(0, -1, 1) * weight.shaped(0, 1, -1)
    # As it is stored, in half precision.
    table = state["share"].reshape(-1, TERMS * state["unit"].shape[-1])
    known = X.sheet.put("Gather", table, row.shaped(0, -1)).of(np.float32)
    mixed = (factor.shaped(0, 1, -1) @ known).shaped(0, TERMS, -1) * state["unit"]
    return (_forms(X.columns(3, 4, 5), X.columns(6)).shaped(0, 1, -1) @ mixed).shaped(0, -1)


def _forms(direction: Wire, force: Wire) -> Wire:
    """`surrogate.regressors.force_series.forms`."""
    found = []
    for order, factors in enumerate(FACTORS):
        products = direction.columns(*factors[0])
        for factor in factors[1:]:
            products = products * direction.columns(*factor)
        found.append(products * force.through("Pow", float(order)))
    return direction.sheet.joined(*found)


def _located(point: Wire, frames: np.ndarray, triangles: np.ndarray) -> tuple[Wire, Wire]:
    """Six places (B, 6) of the triangle nearest to each point (B, 3) [m], and their shares (B, 6), as `Series` has."""
    # (B, S, 4): the shares of the corners, and the height [m].
    found = (point.of(np.float64) @ frames[:, :3].T + frames[:, 3]).shaped(0, -1, 4)
    beside = found.columns(0, 1, 2).least().clip(-np.inf, 0.0)
    miss = found.columns(3).through("Abs") - BESIDE * beside
    best = miss.shaped(0, -1).argmin()
    corner = found.through("GatherND", best, batch_dims=1).of(np.float32).columns(0, 1, 2).clip(0.0, np.inf)
    corner = corner / corner.sum()
    share = point.sheet.joined(corner * (2.0 * corner - 1.0), 4.0 * corner.columns(1, 2, 0) * corner.columns(2, 0, 1))
    return point.sheet.put("GatherND", triangles, best), share


def _between_radii(radius: Wire, radii: np.ndarray) -> tuple[Wire, Wire]:
    """Which radii (B, k), and their weights: the parabola through the three about each radius (B, 1) [m]."""
    width = min(STENCIL, len(radii))
    inside = radius.clip(radii[0], radii[-1])
    first = ((inside > radii).of(np.int64).sum() - 2).clip(0, len(radii) - width)
    index = first + np.arange(width)
    ahead = (inside / radius.sheet.put("Gather", radii, index)).through("Log")
    weight = radius.sheet.constant(np.ones((1, width)))
    for other in range(1, width):
        beside = ahead.columns(*np.roll(np.arange(width), other))
        weight = weight * (beside / (beside - ahead))
    return index, weight


def squares_between(points: Wire, sites: np.ndarray) -> Wire:
    """Squared distances (B, n) of points (B, f) from sites (n, f): |x|^2 - 2 x y + |y|^2, thus in double precision."""
    x, y = points.of(np.float64), sites.astype(np.float64)
    return ((x * x).sum() - x @ (2.0 * y.T) + (y * y).sum(axis=1)).clip(0.0, np.inf)


WIRED: dict[type[Fitted], Callable[[Wire, State], Wire]] = {
    Linear: _linear,
    Pcr: _pcr,
    Ann: _ann,
    Svr: _svr,
    Gp: _gp,
    Remainder: _remainder,
    Series: _series,
}
"""From features (B, f) and `Fitted.state` to coefficients (B, r)."""
