"""How far tissue has relaxed under a tool that a model follows, and whether its training knows such a past.

The finite elements carry the part of the stress that fades, for each pair (g, tau) of a Prony series
(`sim/terms/viscoelastic.py`). A model carries the same of one number, the tool's depth d:

    h <- exp(-dt / tau) h + g exp(-dt / (2 tau)) (d - its last value).

The resistance to a change of shape has then lost the share r = sum_i (g_i - h_i / d), which all else depends on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Pushed
from sim.material import Pairs

from ..data.encode import directions
from ..data.holding import unfaded

MEMORY = "relaxation"
"""Its name in `Deformation.memory`: depth [m], where the tool touched first [m], then each h [m]; (B, 4 + pairs)."""
# A tool that goes back leaves tissue that pushes less than it would at rest, h below zero: by more than this share of
# g d no training row is like it. Nor is one where a tool has slid by more than this share of its footprint's radius.
BACK, SLID = 0.02, 0.5


@dataclass(frozen=True, eq=False)
class Relaxed:
    """B tools in tissue that relaxes.

    Parameters
    ----------
    share
        (B,): r, of the resistance to a change of shape.
    strange
        (B,) bool: whether no history of the training is like theirs.
    memory
        What the next moment needs, as `MEMORY` has it.
    """

    share: np.ndarray
    strange: np.ndarray
    memory: np.ndarray


def followed(series: Pairs, pushed: Pushed, times: np.ndarray, start: Deformation | None, shallowest: float) -> Relaxed:
    """Tools at indentations, from the answer before; without one, each is a history of `holding`.

    Parameters
    ----------
    pushed
        Indentations of B tools.
    times
        (B,) [s].
    start
        An answer of a model of the same series, of earlier or the same times.
    shallowest
        Depth [m] under which tissue is taken to be free.

    Raises
    ------
    InputError
        A start without such a memory, or of later times.
    """
    depth, (g, tau) = directions(pushed)[0], np.array(series).T
    if start is None:
        left = unfaded(series, times) * depth[:, None]
        return _relaxed(g, pushed, depth, pushed.point, left, shallowest)
    past = start.memory.get(MEMORY)
    if past is None or past.shape != (len(depth), 4 + len(series)):
        raise InputError(
            "the start does not say how far the tissue has relaxed: start from this model's own answer, or from none."
        )
    steps = times - start.time
    if (steps < 0.0).any():
        raise InputError(f"the start is {-steps.min():g} s later than the loads: time goes on.")
    half = np.exp(-steps[:, None] / (2.0 * tau))
    left = half * (half * past[:, 4:] + g * (depth - past[:, 0])[:, None])
    first = np.where((past[:, 0] > 0.0)[:, None], past[:, 1:4], pushed.point)
    return _relaxed(g, pushed, depth, first, left, shallowest)


def _relaxed(
    g: np.ndarray, pushed: Pushed, depth: np.ndarray, first: np.ndarray, left: np.ndarray, shallowest: float
) -> Relaxed:
    """From what is left (B, n) [m] of each pair, and where tools touched first (B, 3) [m]."""
    touching = depth > 0.0
    share = (g - left / np.where(touching, depth, 1.0)[:, None]).sum(axis=1)
    back = (left < -BACK * g * np.maximum(depth, shallowest)[:, None]).any(axis=1)
    slid = np.linalg.norm(pushed.point - first, axis=1) > SLID * pushed.footprint
    memory = np.column_stack([depth, first, left])
    return Relaxed(np.clip(np.where(touching, share, 0.0), 0.0, g.sum()), back | (slid & touching), memory)
