"""Boundary value problem: energy as a sum of terms, under constraints."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..loads import Loads
from ..runtime.columns import combine_columns, compute_norms
from ..runtime.device import Device
from ..runtime.views import get_library, run_in_order, to_host, to_view
from .constraint import Constraint
from .term import AssembledTerm, Barrier, Cases, StepTerm, StrainTerm, Term


@dataclass(frozen=True, eq=False)
class ImposedMotion:
    """Prescribed values of a batch: the arguments of `Constraint.begin`."""

    displacement: np.ndarray | None = None
    footprint: np.ndarray | None = None
    motion: np.ndarray | None = None


def build_zero_motion(loads: Loads) -> ImposedMotion:
    """Return zero displacement of fixed components and no footprint motion, for loads without prescribed motion."""
    return ImposedMotion()


@dataclass(frozen=True, eq=False)
class Problem:
    """Boundary value problem with N nodes on one device: energy terms, constraints, and prescribed displacements.

    Arrays are (3N, b), with one column per active load case. `barriers` are the contact terms. `is_elastic` is False if
    user-defined terms also resist deformation. A violation of constraints by at most `gap_round_off` units of round-off
    of the largest displacement counts as zero.
    """

    terms: tuple[Term, ...]
    constraint: Constraint
    device: Device
    build_imposed: Callable[[Loads], ImposedMotion] = build_zero_motion
    barriers: tuple[Barrier, ...] = ()
    is_elastic: bool = True
    gap_round_off: float = 100.0

    @property
    def rows(self) -> int:
        """Number of unknowns 3N."""
        return self.constraint.fixed.size

    @property
    def can_accelerate(self) -> bool:
        """True if all terms are constant loads or passive, as solver accelerations require."""
        return self.is_elastic and all(term.constant or term.passive for term in self.terms)

    @property
    def prevents_inversion(self) -> bool:
        """True if the energy of all elastic terms is infinite for inverted elements."""
        return self.is_elastic and all(term.prevents_inversion for term in self.terms if isinstance(term, StrainTerm))

    @property
    def is_steep(self) -> bool:
        """True if the tangent of a term may differ strongly from the undeformed stiffness."""
        return any(term.steep for term in self.terms)

    @property
    def depends_on_step(self) -> bool:
        """True if the stiffness depends on the time step."""
        return any(isinstance(term, StepTerm) for term in self.terms)

    def find_overlaps(self, u: wp.array) -> np.ndarray:
        """Return masks (2, b) of load cases with overlaps in any barrier; see `Barrier.find_overlaps`."""
        none = np.zeros((2, u.shape[1]), bool)
        return np.logical_or.reduce([none, *(term.find_overlaps(u) for term in self.barriers)])

    def begin(self, cases: Cases) -> None:
        """Set the load cases of a batch."""
        imposed = self.build_imposed(cases.loads)
        self.constraint.begin(imposed.displacement, imposed.footprint, imposed.motion)
        for term in self.terms:
            term.begin(cases)

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the load cases `columns` (k,) of the batch."""
        self.constraint.keep(columns)
        for term in self.terms:
            term.keep(columns)

    def end(self, u: wp.array) -> Mapping[str, Any]:
        """Return the history variables of all history-dependent terms at the solution u, by term name."""
        kept = {term.name: term.end(u) for term in self.terms}
        return {name: memory for name, memory in kept.items() if memory is not None}

    def energy(self, u: wp.array) -> np.ndarray:
        """Return the total potential energy (b,) [J] at u (3N, b); +inf outside the domain of the energy."""
        out = wp.zeros(u.shape[1], dtype=wp.float64, device=self.device.name)
        for term in self.terms:
            term.energy(u, out)
        return out.numpy()

    def gradient(self, u: wp.array) -> wp.array:
        """Return the gradient (3N, b) [N] of the total potential energy at u (3N, b)."""
        out = self.device.allocate(*u.shape)
        for term in self.terms:
            term.add_gradient(u, out)
        return out

    def residual(self, u: wp.array) -> tuple[wp.array, np.ndarray, np.ndarray]:
        """Return the residual (3N, b) [N], which is the projected gradient, its 2-norm (b,), and its scale (b,).

        The scale is the largest 2-norm among the gradients of the terms and the reaction at constrained nodes.
        """
        total, scale = self.device.allocate(*u.shape), np.zeros(u.shape[1])
        for term in self.terms:
            own = self.device.allocate(*u.shape)
            term.add_gradient(u, own)
            scale = np.maximum(scale, compute_norms(self.device, own))
            combine_columns(self.device, total, 1.0, own, total)
        whole = compute_norms(self.device, total)
        self.constraint.project(total)
        free = compute_norms(self.device, total)
        with np.errstate(invalid="ignore", over="ignore"):  # overflow is visible to the caller in `free`
            reaction = np.sqrt(np.maximum(whole**2 - free**2, 0.0))  # the projection is orthogonal
            scale = np.maximum(scale, reaction)
        # Report inf if constrained forces overflowed, which the free residual does not show.
        return total, np.where(np.isfinite(scale), free, np.inf), scale

    def compute_gap(self, u: wp.array) -> tuple[wp.array, np.ndarray]:
        """Return the smallest motion (3N, b) [m] that makes u satisfy the constraints, and a mask (b,) of violations.

        A violation of the order of round-off is not marked and gives zero motion.
        """
        gap, size = self.constraint.close_gap(u)
        with run_in_order(self.device):
            largest = to_host(get_library(self.device).amax(abs(to_view(u)), 0)) if u.size else np.zeros(u.shape[1])
        off = size > self.gap_round_off * np.finfo(self.device.precision).eps * largest
        return combine_columns(self.device, gap, off - 1.0, gap, gap), off

    def linearise(self, u: wp.array, definite: np.ndarray) -> None:
        """Set the linearisation point u; `definite` (b,) requests a positive semi-definite tangent stiffness."""
        flags = self.device.upload(definite.astype(np.int32), wp.int32)
        for term in self.terms:
            term.linearise(u, flags)

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the product K p of the tangent stiffness and p (3N, b) to out (3N, b) [N], without projection."""
        for term in self.terms:
            term.add_curvature(p, out)

    def compute_diagonal(self, columns: int) -> wp.array:
        """Return the 3 x 3 diagonal blocks (N, b) of the tangent stiffness [N/m]."""
        out = wp.zeros((self.rows // 3, columns), dtype=self.device.matrix, device=self.device.name)
        for term in self.terms:
            term.add_diagonal(out)
        return out

    def rest_curvature(self, time_step: float = math.inf) -> sp.csc_array:
        """Return the sum of the undeformed stiffnesses (3N, 3N) [N/m] that terms provide, for a time step [s]."""
        offered = [term.rest_curvature() for term in self.terms]
        if time_step < math.inf:
            offered += [term.compute_step_stiffness(time_step) for term in self.terms if isinstance(term, StepTerm)]
        return self._add_matrices(offered)

    def assemble_stiffness(self, u: wp.array) -> sp.csc_array:
        """Return the tangent stiffness (3N, 3N) [N/m] at u (3N, 1) [m], without barriers.

        Terms without an assembled tangent are included with their undeformed stiffness.
        """
        definite = wp.zeros(1, dtype=wp.int32, device=self.device.name)

        def assemble(term: Term) -> sp.csc_array | None:
            if not isinstance(term, AssembledTerm):
                return term.rest_curvature()
            term.linearise(u, definite)
            return term.assemble_stiffness()

        return self._add_matrices(map(assemble, self.terms))

    def _add_matrices(self, matrices: Iterable[sp.csc_array | None]) -> sp.csc_array:
        """Return the sum (3N, 3N) of the matrices that are not None."""
        given = (matrix for matrix in matrices if matrix is not None)
        return reduce(lambda a, b: a + b, given, sp.csc_array((self.rows, self.rows)))

    def longest_step(self, u: wp.array, du: wp.array) -> np.ndarray:
        """Return the largest fraction (b,), at most 1, of du (3N, b) that stays inside the domain of all terms."""
        out = wp.full(u.shape[1], 1.0, dtype=self.device.scalar, device=self.device.name)
        for term in self.terms:
            term.longest_step(u, du, out)
        return out.numpy().astype(np.float64)
