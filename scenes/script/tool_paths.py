"""Scripted tool motion, which replaces a surgeon's hand, as pure functions of time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Touch:
    """Requested tool input at one time.

    Parameters
    ----------
    x, y
        Position in the tangent plane of the open cortex, relative to its centre [m].
    force
        Force [N]; 0: no contact.
    tilt
        Angles [rad] between force and inward normal, towards x and towards y.
    depth
        Depth [m] of a tool with prescribed pose beyond first contact with the undeformed tissue, in the direction of
        `tilt`; negative: above the tissue.
    """

    x: float = 0.0
    y: float = 0.0
    force: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    depth: float = 0.0


Path = Callable[[float], Touch]
"""Function of time [s] that returns the tool input."""

IDLE_HEIGHT = 4e-3  # Height of an idle tool above the tissue [m].


# Force below which a tool is drawn above the tissue [N]: so small that no visible tool acts through the air.
MIN_VISIBLE_FORCE = 2e-3


def compute_tool_height(force: float) -> float:
    """Return the height [m] above the tissue at which a tool with this force [N] is drawn: `IDLE_HEIGHT` at 0 N."""
    return IDLE_HEIGHT * max(0.0, 1.0 - force / MIN_VISIBLE_FORCE)


def smooth_step(t: float) -> float:
    """Return the minimum-jerk polynomial 6 t^5 - 15 t^4 + 10 t^3, with t clipped to [0, 1] and zero slope at the ends.

    Flash, Hogan 1985, J. Neurosci. 5:1688-1703.
    """
    t = min(max(t, 0.0), 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def keep_idle(time: float) -> Touch:
    """Return a tool input without contact, at any time [s]."""
    return Touch()


def press(force: float, rise: float = 1.5, hold: float = 1.0, at: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Build a path that presses one position: rise to `force` [N] in `rise` [s], stay `hold` [s], release in `rise`.

    Examples
    --------
    >>> from scenes import press
    >>> path = press(0.3, rise=1.0, hold=2.0)
    >>> [round(path(time).force, 2) for time in (0.0, 0.5, 1.0, 3.0, 4.0)]  # [N]
    [0.0, 0.15, 0.3, 0.3, 0.0]
    """

    def get_touch(time: float) -> Touch:
        return Touch(*at, force * (smooth_step(time / rise) - smooth_step((time - rise - hold) / rise)))

    return get_touch


def slide(
    force: float, start: tuple[float, float], end: tuple[float, float], seconds: float, rise: float = 0.5
) -> Path:
    """Build a path that presses with `force` [N], moves from `start` to `end` [m] within `seconds`, and releases."""

    def get_touch(time: float) -> Touch:
        share = smooth_step((time - rise) / seconds)
        x, y = (1.0 - share) * np.array(start) + share * np.array(end)
        pressed = smooth_step(time / rise) - smooth_step((time - rise - seconds) / rise)
        return Touch(float(x), float(y), force * pressed)

    return get_touch


def draw(force: float, tilt: float, rise: float = 1.5, hold: float = 2.0, at: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Build a path that presses, tilts the force by `tilt` [rad] towards x, stays for `hold` [s], and releases."""

    def get_touch(time: float) -> Touch:
        drawn = smooth_step((time - 0.5 * rise) / rise)
        let_go = smooth_step((time - 1.5 * rise - hold) / rise)
        return Touch(*at, force * (smooth_step(time / rise) - let_go), (tilt * drawn, 0.0))

    return get_touch


def palpate(
    depth: float, start: tuple[float, float], end: tuple[float, float], seconds: float, rise: float = 0.8
) -> Path:
    """Build a path that lowers to `depth` [m] in `rise` [s], slides from `start` to `end` [m], and lifts off."""
    stroke = slide(1.0, start, end, seconds, rise)

    def get_touch(time: float) -> Touch:
        touch = stroke(time)
        return Touch(touch.x, touch.y, depth=_interpolate_depth(touch.force, depth))

    return get_touch


def lay(
    depth: float, tilt: float = 0.0, rise: float = 1.5, at: tuple[float, float] = (0.0, 0.0), hold: float = np.inf
) -> Path:
    """Build a path that lowers to `depth` [m] in `rise` [s] with a `tilt` [rad] towards x, stays, and lifts off."""

    def get_touch(time: float) -> Touch:
        share = smooth_step(time / rise) - smooth_step((time - rise - hold) / rise)
        return Touch(*at, tilt=(tilt, 0.0), depth=_interpolate_depth(share, depth))

    return get_touch


def _interpolate_depth(fraction: float, depth: float) -> float:
    """Return the depth [m] of a tool after a share (0 to 1) of the distance from `IDLE_HEIGHT` to `depth` [m]."""
    return fraction * (IDLE_HEIGHT + depth) - IDLE_HEIGHT


def stroke_cortex(force: float, radius: float, speed: float) -> Path:
    """Build a path of straight strokes at `speed` [m/s], without pause, between points of a circle of `radius` [m].

    Successive points differ by the golden angle, so that no stroke is repeated and strokes cover the circle evenly.
    """
    turn = np.pi * (3.0 - np.sqrt(5.0))
    stroke = 2.0 * radius * np.sin(turn / 2.0)

    def get_touch(time: float) -> Touch:
        number, share = divmod(speed * time / stroke, 1.0)
        start, end = (radius * np.array([np.cos(k * turn), np.sin(k * turn)]) for k in (number, number + 1.0))
        x, y = (1.0 - share) * start + share * end
        return Touch(float(x), float(y), force)

    return get_touch


def shift_path(path: Path, tip: Sequence[float]) -> Path:
    """Return a tool path shifted by `tip` (3,) [m]: to the right, upwards and inwards."""

    def get_touch(time: float) -> Touch:
        touch = path(time)
        return replace(touch, x=touch.x + tip[0], y=touch.y + tip[1], depth=touch.depth + tip[2])

    return get_touch
