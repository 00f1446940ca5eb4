"""Scripted tool motion as pure functions of time: what a surgeon's hand does, without a surgeon."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Touch:
    """Requested tool input at one time.

    Parameters
    ----------
    x, y
        Position on the open cortex, in its tangent plane, from its centre [m].
    force
        Force [N]; zero is no contact.
    tilt
        Direction of the force against the inward normal, towards x and y [rad].
    depth
        Depth of a moved tool beyond first contact with the undeformed tissue [m], along that direction; negative in the
        air.
    """

    x: float = 0.0
    y: float = 0.0
    force: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    depth: float = 0.0


Path = Callable[[float], Touch]
"""Function of time [s] that returns a touch."""

IDLE_HEIGHT = 4e-3  # Height of an idle tool above the tissue [m].


# Force below which a tool is drawn above the tissue [N]: so small that no visible tool acts through the air.
MIN_VISIBLE_FORCE = 2e-3


def compute_tool_height(force: float) -> float:
    """Return the height [m] above the tissue of a drawn tool that pushes with a force [N]: `IDLE_HEIGHT` when idle."""
    return IDLE_HEIGHT * max(0.0, 1.0 - force / MIN_VISIBLE_FORCE)


def smooth_step(t: float) -> float:
    """Return the minimum-jerk polynomial 6 t^5 - 15 t^4 + 10 t^3, from 0 to 1 for t from 0 to 1, at rest at both ends.

    Flash, Hogan 1985, J. Neurosci. 5:1688-1703.
    """
    t = min(max(t, 0.0), 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def keep_idle(time: float) -> Touch:
    """Return no contact at any time [s]."""
    return Touch()


def press(force: float, rise: float = 1.5, hold: float = 1.0, at: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Press one position up to `force` [N] within `rise` [s], hold [s], and release as slowly.

    Examples
    --------
    >>> from scenes import press
    >>> path = press(0.3, rise=1.0, hold=2.0)
    >>> [round(path(time).force, 2) for time in (0.0, 0.5, 1.0, 3.0, 4.0)]  # [N]
    [0.0, 0.15, 0.3, 0.3, 0.0]
    """

    def path(time: float) -> Touch:
        return Touch(*at, force * (smooth_step(time / rise) - smooth_step((time - rise - hold) / rise)))

    return path


def slide(
    force: float, start: tuple[float, float], end: tuple[float, float], seconds: float, rise: float = 0.5
) -> Path:
    """Press with `force` [N], move from `start` to `end` [m] within `seconds`, and release."""

    def path(time: float) -> Touch:
        share = smooth_step((time - rise) / seconds)
        x, y = (1.0 - share) * np.array(start) + share * np.array(end)
        pressed = smooth_step(time / rise) - smooth_step((time - rise - seconds) / rise)
        return Touch(float(x), float(y), force * pressed)

    return path


def draw(force: float, tilt: float, rise: float = 1.5, hold: float = 2.0, at: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Press, then draw the tissue aside: the force turns by `tilt` [rad] towards x while it rises; hold; release."""

    def path(time: float) -> Touch:
        drawn = smooth_step((time - 0.5 * rise) / rise)
        let_go = smooth_step((time - 1.5 * rise - hold) / rise)
        return Touch(*at, force * (smooth_step(time / rise) - let_go), (tilt * drawn, 0.0))

    return path


def palpate(
    depth: float, start: tuple[float, float], end: tuple[float, float], seconds: float, rise: float = 0.8
) -> Path:
    """Lower by `IDLE_HEIGHT` [m], then to `depth` [m] in `rise` [s], slide from `start` to `end` [m], lift off."""
    stroke = slide(1.0, start, end, seconds, rise)

    def path(time: float) -> Touch:
        touch = stroke(time)
        return Touch(touch.x, touch.y, depth=_interpolate_depth(touch.force, depth))

    return path


def lay(
    depth: float, tilt: float = 0.0, rise: float = 1.5, at: tuple[float, float] = (0.0, 0.0), hold: float = np.inf
) -> Path:
    """Lower by `IDLE_HEIGHT` and on to `depth` [m] within `rise` [s], `tilt` [rad] towards x; hold [s]; lift off."""

    def path(time: float) -> Touch:
        share = smooth_step(time / rise) - smooth_step((time - rise - hold) / rise)
        return Touch(*at, tilt=(tilt, 0.0), depth=_interpolate_depth(share, depth))

    return path


def _interpolate_depth(share: float, depth: float) -> float:
    """Return the depth [m] of a tool after a share of its way from the air to `depth` [m]."""
    return share * (IDLE_HEIGHT + depth) - IDLE_HEIGHT


def stroke_cortex(force: float, radius: float, speed: float) -> Path:
    """Stroke without a pause at `speed` [m/s] in straight lines between points of a circle of `radius` [m].

    Successive points differ by the golden angle: no stroke is repeated, and strokes cover the circle evenly.
    """
    turn = np.pi * (3.0 - np.sqrt(5.0))
    stroke = 2.0 * radius * np.sin(turn / 2.0)

    def path(time: float) -> Touch:
        number, share = divmod(speed * time / stroke, 1.0)
        start, end = (radius * np.array([np.cos(k * turn), np.sin(k * turn)]) for k in (number, number + 1.0))
        x, y = (1.0 - share) * start + share * end
        return Touch(float(x), float(y), force)

    return path
