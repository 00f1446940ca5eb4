"""State of the load cases of a contact solve, with models of their stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..minimisers.compact_lbfgs import BatchHistory
from ..minimisers.residual import ResidualEvaluator, compute_relative_residual
from .strained_part import StrainedModel


@dataclass(frozen=True, eq=False)
class ContactState:
    """Displacements u (3N, b) [m]; gradients (3N, b) [N] of smooth and of all terms, their 2-norms and scales (b,)."""

    u: Any
    smooth_gradient: Any
    gradient: Any
    norm: np.ndarray
    scale: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Relative residual (b,) of each load case."""
        return compute_relative_residual(self.norm, self.scale)

    @property
    def is_finite(self) -> np.ndarray:
        """Mask (b,) of load cases with finite residual and scale, since forces may overflow."""
        return np.isfinite(self.norm) & np.isfinite(self.scale)

    def select(self, columns: np.ndarray) -> ContactState:
        """Return the state of the load cases `columns` (k,)."""
        parts = (self.u[:, columns], self.smooth_gradient[:, columns], self.gradient[:, columns])
        return ContactState(*parts, self.norm[columns], self.scale[columns])

    def put_columns(self, columns: np.ndarray, index: Any, source: ContactState) -> None:
        """Overwrite load cases `columns` (k,) with those of `source`; `index` is the selection for device arrays."""
        for name in ("u", "smooth_gradient", "gradient"):
            getattr(self, name)[:, index] = getattr(source, name)[:, index]
        self.norm[columns], self.scale[columns] = source.norm[columns], source.scale[columns]


@dataclass(eq=False)
class Batch:
    """Unfinished load cases, on the last axis of arrays (.., b); each has its own direction, step and proximal term.

    evaluator, state
        Function that evaluates residuals, and the current state.
    history, model
        L-BFGS histories, or models of strained tissue that correct the undeformed compliance. `is_stale` (b,) marks
        models that must be recomputed.
    force, response, target_force
        Tool forces (3n, b) [N]; linear response (3N, b) [m] of the undeformed mesh to the residual with these forces;
        tool forces (3n, b) [N] after the step, if there is a model.
    d, step_length, predicted_decrease
        Direction (3N, b) [m], trial step length (b,), and predicted decrease of the energy (b,) [J].
    proximal, stall_counts, steps
        Proximal coefficient (b,), number (b,) of successive steps with little progress, and number (b,) of steps.
    failure_counts, is_waiting, has_ended
        Number (b,) of successive failures of the contact forces; mask (b,) of load cases to be tried again; mask (b,)
        of load cases that have ended, but are still in the arrays.
    """

    evaluator: ResidualEvaluator
    state: ContactState
    history: BatchHistory
    model: StrainedModel | None
    is_stale: np.ndarray
    force: Any
    response: Any
    target_force: Any
    d: Any
    step_length: np.ndarray
    predicted_decrease: np.ndarray
    proximal: np.ndarray
    stall_counts: np.ndarray
    steps: np.ndarray
    failure_counts: np.ndarray
    is_waiting: np.ndarray
    has_ended: np.ndarray

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the load cases `columns` (k,)."""
        self.evaluator, self.state = self.evaluator.select(columns), self.state.select(columns)
        if self.model is None:
            self.history.keep(columns)
        else:
            self.model = self.model.select(columns)
        self.force, self.target_force = self.force[:, columns], self.target_force[:, columns]
        self.response, self.d = self.response[:, columns], self.d[:, columns]
        names = ("is_stale", "is_waiting", "has_ended", "steps", "proximal")
        for name in (*names, "step_length", "predicted_decrease", "stall_counts", "failure_counts"):
            setattr(self, name, getattr(self, name)[columns])

    @property
    def is_updated(self) -> np.ndarray:
        """Mask (b,) of load cases with a model that differs from the undeformed stiffness."""
        return self.history.count > 0 if self.model is None else self.model.is_strained

    def reset_model(self, columns: np.ndarray) -> None:
        """Reset the model of the load cases `columns` (k,) to the undeformed stiffness."""
        if not len(columns):
            return
        if self.model is None:
            self.history.clear(columns)
        else:
            self.model.reset_columns(columns)
