"""A problem: the sum of its terms over the motions that its constraints leave free."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..loads import Loads
from ..runtime.columns import combine_columns, compute_norms
from ..runtime.device import Device
from ..runtime.views import get_library, run_in_order, to_host, view
from .constraint import Constraint
from .term import Barrier, Cases, Paced, Strained, Term


@dataclass(frozen=True, eq=False)
class Imposed:
    """What loads impose on the constraints; as `Constraint.begin` takes it."""

    value: np.ndarray | None = None
    weight: np.ndarray | None = None
    target: np.ndarray | None = None


def build_no_imposed(loads: Loads) -> Imposed:
    """Held components stay at zero and no footprint is moved."""
    return Imposed()


@dataclass(frozen=True, eq=False)
class Problem:
    """Terms, constraints, and how loads impose displacements; N nodes on one device.

    Arrays are (3N, b): one column per live load case. `barriers` are those of the terms that bodies touch.
    `elastic`: nothing but elasticity resists by itself; an effect of somebody's own might. A gap of up to `closed` last
    digits of the largest displacement is closed.
    """

    terms: tuple[Term, ...]
    constraint: Constraint
    device: Device
    impose: Callable[[Loads], Imposed] = build_no_imposed
    barriers: tuple[Barrier, ...] = ()
    elastic: bool = True
    closed: float = 100.0

    @property
    def rows(self) -> int:
        """3N."""
        return self.constraint.held.size

    @property
    def plain(self) -> bool:
        """Whether forces that stay as they are act on what only ever resists: what shortcuts are made for."""
        return self.elastic and all(term.constant or term.passive for term in self.terms)

    @property
    def bounded(self) -> bool:
        """Whether all that is elastic is infinite where its elements are inside out."""
        return self.elastic and all(term.bounded for term in self.terms if isinstance(term, Strained))

    @property
    def steep(self) -> bool:
        """Whether a term is steep."""
        return any(term.steep for term in self.terms)

    @property
    def paced(self) -> bool:
        """Whether the stiffness depends on the step in time."""
        return any(isinstance(term, Paced) for term in self.terms)

    def overlaps(self, u: wp.array) -> np.ndarray:
        """Columns (2, b) bool as `Barrier.overlaps` of any barrier."""
        none = np.zeros((2, u.shape[1]), bool)
        return np.logical_or.reduce([none, *(term.overlaps(u) for term in self.barriers)])

    def begin(self, cases: Cases) -> None:
        """Take a batch of load cases."""
        imposed = self.impose(cases.loads)
        self.constraint.begin(imposed.value, imposed.weight, imposed.target)
        for term in self.terms:
            term.begin(cases)

    def keep(self, columns: np.ndarray) -> None:
        """Keep these columns (k,): the others have left the batch."""
        self.constraint.keep(columns)
        for term in self.terms:
            term.keep(columns)

    def end(self, u: wp.array) -> Mapping[str, Any]:
        """Return the memory of every term that has one, by name."""
        kept = {term.name: term.end(u) for term in self.terms}
        return {name: memory for name, memory in kept.items() if memory is not None}

    def energy(self, u: wp.array) -> np.ndarray:
        """Total potential (b,) [J]; +inf outside the domain."""
        out = wp.zeros(u.shape[1], dtype=wp.float64, device=self.device.name)
        for term in self.terms:
            term.energy(u, out)
        return out.numpy()

    def gradient(self, u: wp.array) -> wp.array:
        """Return the terms' summed gradient (3N, b) [N]."""
        out = self.device.zeros(*u.shape)
        for term in self.terms:
            term.add_gradient(u, out)
        return out

    def residual(self, u: wp.array) -> tuple[wp.array, np.ndarray, np.ndarray]:
        """Return the free gradient (3N, b) [N], its 2-norm (b,), and the scale (b,) that it is measured against.

        The scale is the largest 2-norm among the terms' own gradients and the reaction at constrained nodes.
        """
        total, scale = self.device.zeros(*u.shape), np.zeros(u.shape[1])
        for term in self.terms:
            own = self.device.zeros(*u.shape)
            term.add_gradient(u, own)
            scale = np.maximum(scale, compute_norms(self.device, own))
            combine_columns(self.device, total, 1.0, own, total)
        whole = compute_norms(self.device, total)
        self.constraint.project(total)
        free = compute_norms(self.device, total)
        with np.errstate(invalid="ignore", over="ignore"):  # forces that overflowed: the caller sees it in `free`
            reaction = np.sqrt(np.maximum(whole**2 - free**2, 0.0))  # the projection is orthogonal
            scale = np.maximum(scale, reaction)
        # Where forces overflowed that are not free, nothing else would look out of balance.
        return total, np.where(np.isfinite(scale), free, np.inf), scale

    def gap(self, u: wp.array) -> tuple[wp.array, np.ndarray]:
        """The least motion (3N, b) [m] from u (3N, b) to the constraints, and which columns (b,) are off them at all.

        What round-off leaves open counts as closed, and its motion is zero.
        """
        gap, size = self.constraint.close_gap(u)
        with run_in_order(self.device):
            largest = to_host(get_library(self.device).amax(abs(view(u)), 0)) if u.size else np.zeros(u.shape[1])
        off = size > self.closed * np.finfo(self.device.precision).eps * largest
        return combine_columns(self.device, gap, off - 1.0, gap, gap), off

    def linearise(self, u: wp.array, definite: np.ndarray) -> None:
        """Fix where `add_curvature` is taken; definite (b,) asks for positive semi-definite curvature."""
        flags = self.device.array(definite.astype(np.int32), wp.int32)
        for term in self.terms:
            term.linearise(u, flags)

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add K p (3N, b) [N], not projected."""
        for term in self.terms:
            term.add_curvature(p, out)

    def diagonal(self, columns: int) -> wp.array:
        """3 x 3 diagonal blocks (N, b) of the curvature [N/m]."""
        out = wp.zeros((self.rows // 3, columns), dtype=self.device.matrix, device=self.device.name)
        for term in self.terms:
            term.add_diagonal(out)
        return out

    def rest_curvature(self, step: float = math.inf) -> sp.csc_array:
        """Assembled curvature at rest (3N, 3N) [N/m] of the terms that offer one, over a step in time [s]."""
        offered = [matrix for matrix in (term.rest_curvature() for term in self.terms) if matrix is not None]
        if step < math.inf:
            offered += [term.curvature_at_pace(step) for term in self.terms if isinstance(term, Paced)]
        return reduce(lambda a, b: a + b, offered, sp.csc_array((self.rows, self.rows)))

    def longest_step(self, u: wp.array, du: wp.array) -> np.ndarray:
        """Return the longest fraction (b,), at most 1, of du (3N, b) that every term allows."""
        out = wp.full(u.shape[1], 1.0, dtype=self.device.scalar, device=self.device.name)
        for term in self.terms:
            term.longest_step(u, du, out)
        return out.numpy().astype(np.float64)
