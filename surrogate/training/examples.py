"""Training examples: loads with their FEM responses, and residuals of models."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..data.cortex_patch import Patch
from ..data.encode import ENCODERS, split_forces
from ..model.learned import ModelPart


@dataclass(frozen=True, eq=False)
class Examples:
    """Loads and their FEM displacements at the tumour and at the remaining open cortex.

    Parameters
    ----------
    loads
        B loads, as pushes.
    tumour, cortex
        Displacements (B, n, 3) [m] of the vertices of the tumour, and of the open cortex without these.
    force
        Force (B, 3) [N] of the tool that is moved by pose; None if not available.
    """

    loads: Pushed
    tumour: np.ndarray
    cortex: np.ndarray
    force: np.ndarray | None = None


def compute_residual_responses(
    parts: Sequence[ModelPart], patch: Patch, loads: Pushed, motion: np.ndarray
) -> np.ndarray:
    """Compute residuals (B, n, 3) [m/N]: displacements `motion` (B, n, 3) [m] per newton minus the parts' responses."""
    response = motion / split_forces(loads)[0][:, None, None]
    for part in parts:
        response = response - part.compute_response(ENCODERS[part.encoder](patch, loads))
    return response
