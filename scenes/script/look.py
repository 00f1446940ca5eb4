"""How a scene looks beside its camera: its lamp, the colour of its cortex, and what lies upon it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cottonoid:
    """A square of wet cotton on the cortex, which moves with it.

    Parameters
    ----------
    x, y
        Its middle in the tangent plane of the open cortex [m].
    side
        [m].
    angle
        By which it is turned in that plane [rad].
    """

    x: float
    y: float
    side: float = 12e-3
    angle: float = 0.0


@dataclass(frozen=True)
class Look:
    """Light, colour and what covers the cortex.

    Parameters
    ----------
    lamp, ambient
        Strengths of the lamp, and of the light from all sides, scene-linear.
    turn
        Angle by which the lamp is turned about the axis of the opening [rad].
    tint
        Multiplies the cortex's red, green and blue.
    vessels
        Seed of vessels that are drawn on the cortex; None: none but the scan's.
    cottonoids
        What lies on the cortex.
    finger
        Direction in the tangent plane from which a gloved finger reaches over the opening's edge [rad]; None: none.
    """

    lamp: float = 1.0
    ambient: float = 0.16
    turn: float = 0.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vessels: int | None = None
    cottonoids: tuple[Cottonoid, ...] = ()
    finger: float | None = None


PLAIN = Look()
"""That of scenes that say nothing else."""
