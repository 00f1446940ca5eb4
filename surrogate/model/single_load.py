"""One load at a time in tens of microseconds: a series and a process, laid out for one kernel on the CPU."""

from __future__ import annotations

from threading import Lock

import numpy as np
import warp as wp

from sim.loads import Pushed
from sim.runtime.device import Device, find_device

from ..data.cortex_patch import Patch
from ..data.encode import Basis
from ..regressors.force_series import ORDERS, Series
from ..regressors.series_residual import Remainder
from .conformal import LEVELS, Bound
from .single_load_bound import Limits, telling
from .single_load_kernel import LANES, Process, Table, answer, features, wide, wide_double
from .training_range import Envelope


class Swift:
    """What `Learned.deform` needs of a series, of what is learnt of its remainder and of their limits, for one load.

    Threads may ask at once; one waits for the other.

    Parameters
    ----------
    series, remainder
        Their responses are added; there may be no remainder.
    basis
        Of both, at most `LANES` modes.
    patch, envelope, bounds
        Where loads lie, which were taught, and what is promised, if anything is.
    """

    def __init__(
        self,
        series: Series,
        remainder: Remainder | None,
        basis: Basis,
        patch: Patch,
        envelope: Envelope,
        bounds: Bound | None,
    ):
        device = find_device("cpu", "float64")
        components = 3 * len(basis.nodes)
        asked, told = device.zeros(7), device.zeros(1 + len(LEVELS))
        field = device.array(np.zeros((-(-components // LANES), LANES)), wide_double)
        self._inputs = [
            asked,
            _table(device, series, basis),
            _process(device, remainder),
            _limits(device, patch, envelope, bounds),
        ]
        # It is launched again and again on the same arrays, which numpy sees as its own.
        self._answer = wp.launch(answer, 1, self._inputs, [field, told], device=device.name, record_cmd=True)
        self._asked, self._told = asked.numpy(), told.numpy()
        self._field = field.numpy().reshape(-1)[:components].reshape(1, -1, 3)
        self._lock = Lock()

    def answer(self, pushed: Pushed) -> tuple[np.ndarray, float, np.ndarray]:
        """Displacement (1, n, 3) [m], `Envelope.excess`, and bounds (2, 1) [m] or NaN, of one load."""
        with self._lock:
            self._asked[:3], self._asked[3:6], self._asked[6] = pushed.point[0], pushed.force[0], pushed.footprint[0]
            self._answer.launch()
            return self._field.copy(), float(self._told[0]), self._told[1:, None].copy()


def _table(device: Device, series: Series, basis: Basis) -> Table:
    table = Table()
    table.frame = device.array(series.frames.reshape(-1, 4, 4), wp.mat44d)
    table.triangle = device.array(series.triangles, wp.int32)
    table.radius = device.array(np.log(series.radii))
    table.row = device.array(_in_lanes(series.table.reshape(-1, len(basis.modes))), wide)
    table.modes = device.array(_in_blocks(basis.modes), wide)
    return table


def _process(device: Device, remainder: Remainder | None) -> Process:
    process = Process()
    if remainder is not None:
        gp = remainder.gp_
        # Rows that fill the last block count for nothing: their dual coefficients are zero.
        process.seen = device.array(_in_blocks(gp.seen_.T), wide_double)
        dual = _in_lanes(gp.dual_.astype(np.float64))
        process.dual = device.array(_in_lanes(dual.T).T.reshape(-1, LANES, LANES), wide_double)
        process.offset = wide_double(*_in_lanes(gp.offset_[None])[0])
        process.mean, process.unit = features(*gp.mean_), features(*(gp.deviation_ * gp.length_))
        process.faint = float(remainder.faint_**ORDERS)
    return process


def _limits(device: Device, patch: Patch, envelope: Envelope, bounds: Bound | None) -> Limits:
    limits = Limits()
    start, end = patch.rim.swapaxes(0, 1)
    limits.taught = device.array(envelope.points.astype(np.float64), wp.vec3d)
    limits.node, limits.inward = device.array(patch.points, wp.vec3d), device.array(patch.inward, wp.vec3d)
    limits.start, limits.along = device.array(start, wp.vec3d), device.array(end - start, wp.vec3d)
    limits.reach, limits.overhang, limits.angle = envelope.reach, envelope.overhang, envelope.angle
    limits.force, limits.footprint = wp.vec2d(*envelope.force), wp.vec2d(*envelope.footprint)
    limits.line_force = envelope.line_force
    if bounds is not None:
        limits.mean, limits.deviation = telling(*bounds.mean), telling(*bounds.deviation)
        limits.weight, limits.edge = device.array(bounds.weights), device.array(bounds.edges)
        limits.quantile = device.array(bounds.quantile.T, wp.vec2d)
    return limits


def _in_lanes(rows: np.ndarray) -> np.ndarray:
    """Rows (n, r) with zeros beside them, up to a multiple of `LANES`."""
    return np.pad(rows, ((0, 0), (0, -rows.shape[1] % LANES)))


def _in_blocks(rows: np.ndarray) -> np.ndarray:
    """Rows (n, r), `LANES` of their numbers at a time: (blocks, n, `LANES`)."""
    return _in_lanes(rows).reshape(len(rows), -1, LANES).swapaxes(0, 1)
