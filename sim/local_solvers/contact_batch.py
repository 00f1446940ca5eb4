"""Columns on their way to where tissue and tools are in equilibrium, and what each of them has learnt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..minimisers.compact_lbfgs import PairsOfColumns
from ..minimisers.residual import Judge, compute_relative
from .strained_part import StrainedModel


@dataclass(frozen=True, eq=False)
class ContactState:
    """u (3N, b) [m]; free gradients (3N, b) [N] of all that is smooth, and of all; 2-norms (b,), and scales (b,)."""

    u: Any
    smooth: Any
    whole: Any
    free: np.ndarray
    scale: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """The relative residuals (b,)."""
        return compute_relative(self.free, self.scale)

    @property
    def finite(self) -> np.ndarray:
        """(b,) bool: whether each is a state at all. Forces that overflow have no scale."""
        return np.isfinite(self.free) & np.isfinite(self.scale)

    def rows(self, stay: np.ndarray) -> ContactState:
        """Return some of the columns (k,)."""
        parts = (self.u[:, stay], self.smooth[:, stay], self.whole[:, stay])
        return ContactState(*parts, self.free[stay], self.scale[stay])

    def put(self, columns: np.ndarray, some: Any, other: ContactState) -> None:
        """Write columns (k,) of another state over these; `some` are the same of an array's."""
        for mine, its in ((self.u, other.u), (self.smooth, other.smooth), (self.whole, other.whole)):
            mine[:, some] = its[:, some]
        self.free[columns], self.scale[columns] = other.free[columns], other.scale[columns]


@dataclass(eq=False)
class Batch:
    """Columns on their way. Arrays (.., b) last; each column aims, tries, and is cut, by itself.

    judge, now
        What measures them, and where they are.
    pairs, model
        What they have learnt, or what strained tissue changes of how the body at rest moves; `stale` (b,) bool says
        whose model is to be made anew.
    force, rest, aimed
        (3n, b) [N] the tools' as the model has them; (3N, b) [m] what the body at rest answers what is out of balance
        under these. Under the third they will be after the step, where there is a model.
    x, length, promised
        (3N, b) [m] the direction, and (b,) the step along it that is tried; what it promises.
    drag, slow, steps
        (b,).
    failed, waiting, gone
        (b,) how often in a row no forces of the tools were found; which (b,) bool are to be tried again, and which have
        ended and stand by until the others close ranks.
    """

    judge: Judge
    now: ContactState
    pairs: PairsOfColumns
    model: StrainedModel | None
    stale: np.ndarray
    force: Any
    rest: Any
    aimed: Any
    x: Any
    length: np.ndarray
    promised: np.ndarray
    drag: np.ndarray
    slow: np.ndarray
    steps: np.ndarray
    failed: np.ndarray
    waiting: np.ndarray
    gone: np.ndarray

    def keep(self, stay: np.ndarray) -> None:
        """Keep these columns (k,)."""
        self.judge, self.now = self.judge.rows(stay), self.now.rows(stay)
        if self.model is None:
            self.pairs.keep(stay)
        else:
            self.model = self.model.rows(stay)
        self.force, self.aimed = self.force[:, stay], self.aimed[:, stay]
        self.rest, self.x = self.rest[:, stay], self.x[:, stay]
        for name in ("stale", "length", "promised", "drag", "slow", "steps", "failed", "waiting", "gone"):
            setattr(self, name, getattr(self, name)[stay])

    @property
    def learnt(self) -> np.ndarray:
        """Which columns (b,) have a model beside the rest."""
        return self.pairs.count > 0 if self.model is None else self.model.bent

    def forget(self, columns: np.ndarray) -> None:
        """Of some columns (k,) nothing is known but the rest."""
        if not len(columns):
            return
        if self.model is None:
            self.pairs.forget(columns)
        else:
            self.model.forget(columns)
