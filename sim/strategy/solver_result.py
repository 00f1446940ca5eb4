"""Result of the solvers for a batch of load cases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from ..runtime.columns import scatter_columns
from ..runtime.device import Device


@dataclass(frozen=True, eq=False)
class SolverResult:
    """Solution u (3N, B) [m] on the device; (B,) outcomes, outer steps, residuals, load fractions, inverted elements.

    `warm_start` is data for the next load. With moving tools, `path_fraction` (B,) is the path fraction
    reached, and `restarted` (B,) marks cases that started from the undeformed state.
    """

    u: wp.array
    outcome: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray
    reached: np.ndarray
    inverted: np.ndarray
    linear_iterations: int
    warm_start: Mapping[str, np.ndarray] = field(default_factory=dict)
    path_fraction: np.ndarray | None = None
    restarted: np.ndarray | None = None

    @property
    def good(self) -> np.ndarray:
        """Mask (B,) of load cases with a good outcome."""
        return np.array([outcome.good for outcome in self.outcome], bool)

    def replace_cases(self, index: np.ndarray, source: SolverResult, device: Device) -> None:
        """Overwrite the results of the cases `index` (k,) with those of `source`; outer steps are added."""
        scatter_columns(device, source.u, index, self.u)
        self.iterations[index] += source.iterations
        for name in ("outcome", "residual", "reached", "inverted"):
            getattr(self, name)[index] = getattr(source, name)
