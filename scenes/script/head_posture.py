"""How the head lies as pure functions of time: which way is down, and how high its fluid stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.bodies.fluid_level import fluid_level
from sim.loads import Posture

from .tool_paths import smooth

SUPINE = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class Lying:
    """How the head lies at one moment, whatever its size.

    Parameters
    ----------
    direction
        Which way gravity pulls (3,), in RAS, of any length but none.
    fluid
        How high the fluid stands, against gravity: from 0, wholly drained, to 1, over the highest vertex.
    """

    direction: tuple[float, float, float] = SUPINE
    fluid: float = 1.0

    def posture(self, nodes: np.ndarray) -> Posture:
        """One load case for a body of these nodes (V, 3) [m]."""
        down = np.array(self.direction) / np.linalg.norm(self.direction)
        return Posture(down[None], np.array([fluid_level(nodes, down, self.fluid)]), np.ones(1))


Lie = Callable[[float], Lying]
"""Time [s] -> Lying."""


def supine(time: float) -> Lying:
    """As in the scan, at any time [s]: on the back, under fluid."""
    return Lying()


def drained(seconds: float, to: float = 0.0) -> Lie:
    """On the back while the fluid falls to a share of its height within so many seconds."""
    return lambda time: Lying(fluid=1.0 - (1.0 - to) * smooth(time / seconds))


def drained_then_turned(drain: float, pause: float, turn: float, angle: float, to: float = 0.0) -> Lie:
    """On the back while the fluid falls to a share within `drain` [s]; `pause` [s]; then a turn by `angle` [rad].

    A positive angle brings the left side down; the turn takes `turn` [s].
    """
    falling = drained(drain, to)

    def lie(time: float) -> Lying:
        turned = angle * smooth((time - drain - pause) / turn)
        return Lying((-float(np.sin(turned)), -float(np.cos(turned)), 0.0), falling(time).fluid)

    return lie
