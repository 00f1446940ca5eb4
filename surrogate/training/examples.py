"""Loads and what they did, and what models leave of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..data.cortex_patch import Patch
from ..data.encode import ENCODERS, directions
from ..model.learned import Part


@dataclass(frozen=True, eq=False)
class Examples:
    """Loads and what they did to the tumour and to the rest of the open cortex.

    Parameters
    ----------
    loads
        B pushes.
    tumour, cortex
        Displacements (B, n, 3) [m].
    force
        (B, 3) [N] that a tool moved by pose exerts, where it is known.
    """

    loads: Pushed
    tumour: np.ndarray
    cortex: np.ndarray
    force: np.ndarray | None = None


def left_by(parts: Sequence[Part], patch: Patch, loads: Pushed, moved: np.ndarray) -> np.ndarray:
    """Responses (B, n, 3) [m/N] that parts leave of motions `moved` (B, n, 3) [m]."""
    response = moved / directions(loads)[0][:, None, None]
    for part in parts:
        response = response - part.response(ENCODERS[part.encoder](patch, loads))
    return response
