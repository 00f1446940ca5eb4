"""Training models on the distance from tip to tumour: a correction, kept where it helps, and a calibrated bound."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim.loads import Loads

from ..data.cortex_patch import Patch
from ..model.learned import Learned
from ..model.tip_distance import MOST, TipModel, fitted_correction


@dataclass(frozen=True, eq=False)
class Measured:
    """Loads, and the finite elements' distances (B,) [m] from tip to tumour under them."""

    loads: Loads
    distance: np.ndarray

    def rows(self, index: np.ndarray | slice) -> Measured:
        """Some of them: numbers, a slice, or (B,) bool."""
        return Measured(self.loads.rows(index), self.distance[index])


def distance_errors(model: Learned, known: Measured) -> np.ndarray:
    """How far (B,) [m] a model's distances are from the finite elements'."""
    return np.abs(model.distance(known.loads).value - known.distance)


def with_correction(model: Learned, patch: Patch, known: Measured) -> Learned:
    """The model with a correction of its distances, learned from its training loads or some of them."""
    plain, some = replace(model, tip=TipModel()), known.rows(slice(None, None, -(-len(known.loads) // MOST)))
    off = some.distance - plain.distance(some.loads).value
    return replace(model, tip=TipModel(fitted_correction(patch, model.asked(some.loads), off)))


def corrected_if_better(
    model: Learned, patch: Patch, trained: Measured, held_out: Measured
) -> tuple[Learned, np.ndarray]:
    """The model with a correction, if that brings held-out distances nearer on average; and their errors (B,) [m]."""
    candidates = [replace(model, tip=TipModel()), with_correction(model, patch, trained)]
    error = [distance_errors(each, held_out) for each in candidates]
    best = int(error[1].mean() < error[0].mean())
    return candidates[best], error[best]
