"""State of the load cases of a contact solve, with their models of the stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..minimisers.compact_lbfgs import BatchHistory
from ..minimisers.residual import ResidualEvaluator, compute_relative_residual
from .strained_part import StrainedModel


@dataclass(frozen=True, eq=False)
class ContactState:
    """State u (3N, b) [m]; gradients (3N, b) [N] of the smooth terms, and of all, with 2-norms (b,); scales (b,)."""

    u: Any
    smooth_gradient: Any
    gradient: Any
    norm: np.ndarray
    scale: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Relative residuals (b,)."""
        return compute_relative_residual(self.norm, self.scale)

    @property
    def is_finite(self) -> np.ndarray:
        """True (b,) where residual and scale are finite; forces may overflow."""
        return np.isfinite(self.norm) & np.isfinite(self.scale)

    def select(self, columns: np.ndarray) -> ContactState:
        """Return the state of some load cases (k,)."""
        parts = (self.u[:, columns], self.smooth_gradient[:, columns], self.gradient[:, columns])
        return ContactState(*parts, self.norm[columns], self.scale[columns])

    def put_columns(self, columns: np.ndarray, index: Any, source: ContactState) -> None:
        """Overwrite load cases (k,) with those of another state; `index` is the same selection for device arrays."""
        for name in ("u", "smooth_gradient", "gradient"):
            getattr(self, name)[:, index] = getattr(source, name)[:, index]
        self.norm[columns], self.scale[columns] = source.norm[columns], source.scale[columns]


@dataclass(eq=False)
class Batch:
    """Live load cases, on the last axis of arrays (.., b); each has its own direction, step length and proximal term.

    evaluator, state
        Function that evaluates residuals, and the present state.
    history, model
        L-BFGS histories, or models of strained tissue that correct the undeformed compliance; `stale` (b,) bool marks
        models to be recomputed.
    force, response, target_force
        (3n, b) [N] forces of the tools; (3N, b) [m] linear response of the undeformed mesh to the residual with these
        forces; (3n, b) [N] forces after the step, if there is a model.
    d, length, decrease
        (3N, b) [m] direction, (b,) trial step length, and (b,) [J] predicted decrease.
    proximal, stalls, steps
        (b,) proximal coefficient, steps in a row with little progress, and number of steps.
    failures, waiting, ended
        (b,) failures in a row to find the tools' forces; (b,) bool: to be tried again; (b,) bool: ended, but still in
        the arrays.
    """

    evaluator: ResidualEvaluator
    state: ContactState
    history: BatchHistory
    model: StrainedModel | None
    stale: np.ndarray
    force: Any
    response: Any
    target_force: Any
    d: Any
    length: np.ndarray
    decrease: np.ndarray
    proximal: np.ndarray
    stalls: np.ndarray
    steps: np.ndarray
    failures: np.ndarray
    waiting: np.ndarray
    ended: np.ndarray

    def keep(self, columns: np.ndarray) -> None:
        """Keep these load cases (k,)."""
        self.evaluator, self.state = self.evaluator.select(columns), self.state.select(columns)
        if self.model is None:
            self.history.keep(columns)
        else:
            self.model = self.model.select(columns)
        self.force, self.target_force = self.force[:, columns], self.target_force[:, columns]
        self.response, self.d = self.response[:, columns], self.d[:, columns]
        for name in ("stale", "length", "decrease", "proximal", "stalls", "steps", "failures", "waiting", "ended"):
            setattr(self, name, getattr(self, name)[columns])

    @property
    def is_updated(self) -> np.ndarray:
        """True (b,) where a load case has a model that differs from the undeformed stiffness."""
        return self.history.count > 0 if self.model is None else self.model.is_strained

    def reset_model(self, columns: np.ndarray) -> None:
        """Reset the model of some load cases (k,) to the undeformed stiffness."""
        if not len(columns):
            return
        if self.model is None:
            self.history.clear(columns)
        else:
            self.model.reset_columns(columns)
