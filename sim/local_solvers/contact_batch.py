"""State of the load cases of a contact solve, with their models of the stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..minimisers.compact_lbfgs import BatchHistory
from ..minimisers.residual import ResidualEvaluator, compute_relative
from .strained_part import StrainedModel


@dataclass(frozen=True, eq=False)
class ContactState:
    """State u (3N, b) [m]; gradients (3N, b) [N] of the smooth terms, and of all, with 2-norms (b,); scales (b,)."""

    u: Any
    smooth: Any
    whole: Any
    free: np.ndarray
    scale: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Relative residuals (b,)."""
        return compute_relative(self.free, self.scale)

    @property
    def finite(self) -> np.ndarray:
        """True (b,) where residual and scale are finite; forces may overflow."""
        return np.isfinite(self.free) & np.isfinite(self.scale)

    def select(self, stay: np.ndarray) -> ContactState:
        """Return the state of some load cases (k,)."""
        parts = (self.u[:, stay], self.smooth[:, stay], self.whole[:, stay])
        return ContactState(*parts, self.free[stay], self.scale[stay])

    def put(self, columns: np.ndarray, some: Any, other: ContactState) -> None:
        """Overwrite load cases (k,) with those of another state; `some` is the same selection for device arrays."""
        for mine, its in ((self.u, other.u), (self.smooth, other.smooth), (self.whole, other.whole)):
            mine[:, some] = its[:, some]
        self.free[columns], self.scale[columns] = other.free[columns], other.scale[columns]


@dataclass(eq=False)
class Batch:
    """Live load cases, on the last axis of arrays (.., b); each has its own direction, step length and proximal term.

    evaluator, state
        Function that evaluates residuals, and the present state.
    history, model
        L-BFGS histories, or models of strained tissue that correct the undeformed compliance; `stale` (b,) bool marks
        models to be recomputed.
    force, rest, aimed
        (3n, b) [N] forces of the tools; (3N, b) [m] linear response of the undeformed mesh to the residual with these
        forces; (3n, b) [N] forces after the step, if there is a model.
    x, length, predicted
        (3N, b) [m] direction, (b,) trial step length, and (b,) [J] predicted decrease.
    proximal, stalled, steps
        (b,) proximal coefficient, steps in a row with little progress, and number of steps.
    failed, waiting, ended
        (b,) failures in a row to find the tools' forces; (b,) bool: to be tried again; (b,) bool: ended, but still in
        the arrays.
    """

    evaluator: ResidualEvaluator
    state: ContactState
    history: BatchHistory
    model: StrainedModel | None
    stale: np.ndarray
    force: Any
    rest: Any
    aimed: Any
    x: Any
    length: np.ndarray
    predicted: np.ndarray
    proximal: np.ndarray
    stalled: np.ndarray
    steps: np.ndarray
    failed: np.ndarray
    waiting: np.ndarray
    ended: np.ndarray

    def keep(self, stay: np.ndarray) -> None:
        """Keep these load cases (k,)."""
        self.evaluator, self.state = self.evaluator.select(stay), self.state.select(stay)
        if self.model is None:
            self.history.keep(stay)
        else:
            self.model = self.model.select(stay)
        self.force, self.aimed = self.force[:, stay], self.aimed[:, stay]
        self.rest, self.x = self.rest[:, stay], self.x[:, stay]
        for name in ("stale", "length", "predicted", "proximal", "stalled", "steps", "failed", "waiting", "ended"):
            setattr(self, name, getattr(self, name)[stay])

    @property
    def updated(self) -> np.ndarray:
        """True (b,) where a load case has a model that differs from the undeformed stiffness."""
        return self.history.count > 0 if self.model is None else self.model.bent

    def forget(self, columns: np.ndarray) -> None:
        """Reset the model of some load cases (k,) to the undeformed stiffness."""
        if not len(columns):
            return
        if self.model is None:
            self.history.forget(columns)
        else:
            self.model.forget(columns)
