"""Where pushes go on to: a frame starts from its last answer, moved on along the way from the one before that.

Between neighbouring loads the answer is nearly linear in them. Loads q, p with the answers v, u are followed by p' from
u + a (u - v), a = (p' - p) . (p - q) / |p - q|^2. This goes as far as the load goes on the way that it came. It is
nothing where the load stands still or turns aside, and back on that way where it returns.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arguments import is_all_finite
from ..loads import Loads, Pushed

# Keys of what is warm: the answer's own loads (B, 2, 7), last those before them; displacements (B, 3N) [m] before it.
PUSHES, BEFORE = "pushes", "before"
# A way is followed back to where it began, and on for at most as long again twice.
BACK, ON = -1.0, 2.0


def as_pushes(loads: Loads) -> np.ndarray | None:
    """Point [m], force [N] and footprint [m] (B, 7) of each load; None where anything but a push acts."""
    push = loads.only(Pushed)
    if push is None:
        return None
    return np.column_stack([push.point, push.force, push.footprint])


def compute_shares(now: np.ndarray, last: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return a (B,) for three pushes (B, 7) in turn; zero where one of them has no force, or the last two are the same.

    Lengths are measured against the last footprint, forces against the last force.
    """
    forces = np.stack([now, last, before])[:, :, 3:6]
    size = np.sqrt((forces * forces).sum(axis=2))
    unit = np.repeat(last[:, 6:], 7, axis=1)
    unit[:, 3:6] = size[1][:, None]
    unit[unit == 0.0] = 1.0
    way, further = (last - before) / unit, (now - last) / unit
    square = (way * way).sum(axis=1)
    known = size.all(axis=0) & (square > 0.0)
    share = (further * way).sum(axis=1) / np.where(known, square, 1.0)
    return np.where(known, share.clip(BACK, ON), 0.0)


def has_warm_state(warm: Mapping[str, Any], last: np.ndarray) -> bool:
    """Whether what is warm says how answers (3N, B) came about."""
    if BEFORE not in warm or PUSHES not in warm:
        return False
    fits = warm[BEFORE].shape == last.T.shape and warm[PUSHES].shape == (last.shape[1], 2, 7)
    return fits and is_all_finite(warm[BEFORE]) and is_all_finite(warm[PUSHES])


def extrapolate_start(loads: Loads, last: np.ndarray, warm: Mapping[str, Any]) -> np.ndarray:
    """Extrapolate starts (3N, B) [m] from the last solutions (3N, B); return these if there is no direction."""
    now = as_pushes(loads)
    if now is None or not has_warm_state(warm, last):
        return last
    came, before = warm[PUSHES][:, 0], warm[PUSHES][:, 1]
    return last + compute_shares(now, came, before) * (last - warm[BEFORE].T)


def compute_directions(
    now: np.ndarray | None, last: np.ndarray | None, warm: Mapping[str, Any]
) -> dict[str, np.ndarray]:
    """What the answers to pushes (B, 7) hand on, whose last answers (3N, B) were left with it, if there were any."""
    if now is None:
        return {}
    if last is None or PUSHES not in warm or warm[PUSHES].shape != (len(now), 2, 7):
        return {PUSHES: np.stack([now, now], axis=1)}
    return {PUSHES: np.stack([now, warm[PUSHES][:, 0]], axis=1), BEFORE: last.T}
