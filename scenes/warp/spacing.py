"""How far apart a field's nodes are: as asked, or so near that tumour and landmarks are exact."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sim.errors import InputError
from sim.fields.warp_fields import WarpFields, warp_fields, warp_grid

from .moment import Moment
from .places import places_of

FINEST, COARSEST, FIRST = 0.3e-3, 5e-3, 1e-3
"""Spacings of a field [m], and the one that is tried first."""
ENOUGH = 0.05e-3
"""The error of tumour and landmarks that a spacing is looked for to reach [m]."""
MOST, MOST_ASKED = 32_000_000, 96_000_000
"""Nodes of a field: where it is looked for, and where it is asked for. A million take 12 MB of memory."""
# A spacing is looked for in steps of this [m]; the error falls with it, with so much to spare; so often it is tried.
STEP, SPARE, TIMES = 0.05e-3, 0.95, 3


def steps_of(spacing: float | None) -> int:
    """How many steps `fields_of` takes: two fields, as often as a spacing is tried."""
    return 2 * (1 + (TIMES if spacing is None else 0))


def fields_of(moment: Moment, spacing: float | None, step: Callable[[int], object]) -> WarpFields:
    """The fields of a moment at a spacing [m]; None: at 1 mm, or finer where tumour or landmarks are off by more.

    `step` hears of how many more of `steps_of` are done.

    Raises
    ------
    InputError
        A spacing that makes too many nodes.
    """
    if spacing is not None and (nodes := _nodes(moment, spacing)) > MOST_ASKED:
        raise InputError(
            f"--spacing {1e3 * spacing:g}: the fields would have {nodes / 1e6:.0f} million nodes, and "
            f"{MOST_ASKED / 1e6:.0f} million are the most. Give a larger one."
        )
    left = steps_of(spacing) - 2
    fields = _fields(moment, spacing or FIRST, step)
    while left and (finer := finer_spacing(moment, fields)) is not None:
        fields, left = _fields(moment, finer, step), left - 2
    step(left)
    return fields


def finer_spacing(moment: Moment, fields: WarpFields) -> float | None:
    """A spacing [m] at which both are exact enough, or as near as size allows; None where no finer one helps."""
    now = fields.grid.spacing
    places = places_of(moment)
    worst = float(places.errors(fields)[places.tumour | places.landmarks].max(initial=0.0))
    if worst <= ENOUGH:
        return None
    steps = max(math.floor(SPARE * now * ENOUGH / worst / STEP), round(FINEST / STEP))
    while _nodes(moment, STEP * steps) > MOST:
        steps += 1
    return STEP * steps if steps < round(now / STEP) else None


def _nodes(moment: Moment, spacing: float) -> float:
    return float(np.prod(warp_grid(moment.anatomy, moment.displacement[None], spacing).shape, dtype=float))


def _fields(moment: Moment, spacing: float, step: Callable[[int], object]) -> WarpFields:
    return warp_fields(moment.anatomy, moment.displacement, spacing, moment.left, lambda: step(1))
