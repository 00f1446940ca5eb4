"""Search directions of the outer iteration: small classes, chosen by measurement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import warp as wp

from .columns import combined, dots, gathered, norms
from .device import Device
from .linear import Preconditioner, conjugate_gradients
from .problem import Problem

# The next step may be so many times as long as the one that was taken.
GROWTH = 2.0
# Pairs along which the gradient hardly changes, or against the step, say nothing of a positive definite curvature.
LEAST_CURVATURE = 1e-6


@dataclass(frozen=True, eq=False)
class Direction:
    """d (3N, b) [m]; the decrease (b,) [J] that the linear model promises along it; linear iterations spent."""

    d: wp.array
    promised: np.ndarray
    iterations: int


class Descent(Protocol):
    """Where to go next, for b load cases at once; it remembers what a batch has taught it."""

    def begin(self) -> None:
        """Forget: another batch begins."""
        ...

    def keep(self, device: Device, columns: np.ndarray) -> None:
        """Keep these columns (k,): the others have left the batch."""
        ...

    def find(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, taken: np.ndarray
    ) -> Direction:
        """Direction at u (3N, b) with free gradient g (3N, b) [N].

        `gap` (3N, b) [m], if any, is the motion that closes the constraints; the free nodes follow it. `forcing` (b,):
        the linear residual that may be left, relative to the right-hand side. `taken` (b,): the share of the last
        direction that was gone; where it was none, the curvature at rest stands in for one that misled. Nobody changes
        g after the call, nor d.
        """
        ...


class NewtonCG:
    """Inexact Newton: K d = -g by truncated conjugate gradients, within a radius that follows the steps taken.

    The radius is in the preconditioner's norm, and infinite until a step has been cut: Steihaug 1983.
    """

    def __init__(self, preconditioner: Preconditioner, most: int):
        self._preconditioner, self._most = preconditioner, most
        self.begin()

    def begin(self) -> None:
        """No radius yet."""
        self._radius: np.ndarray | None = None
        self._size, self._truncated = np.zeros(0), np.zeros(0, bool)

    def keep(self, device: Device, columns: np.ndarray) -> None:
        """Keep the radii of these columns (k,)."""
        if self._radius is not None:
            self._radius, self._size = self._radius[columns], self._size[columns]
            self._truncated = self._truncated[columns]

    def find(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, taken: np.ndarray
    ) -> Direction:
        """As `Descent`."""
        device, columns = problem.device, u.shape[1]
        definite = taken == 0.0
        problem.linearise(u, definite)
        self._preconditioner.prepare(problem, columns)
        rhs, pulled = right_hand_side(problem, g, gap)
        # What follows a gap must follow it whole, and the curvature at rest misleads no one.
        self._radius = np.where(pulled | definite, np.inf, self._followed(taken))
        tolerance = forcing * norms(device, rhs)
        found = conjugate_gradients(problem, self._preconditioner, wp.clone(rhs), tolerance, self._most, self._radius)
        self._size, self._truncated = found.size, found.truncated
        promised = dots(device, rhs, found.x)
        return Direction(closing(device, found.x, gap), promised, found.iterations)

    def _followed(self, taken: np.ndarray) -> np.ndarray:
        if self._radius is None:
            return np.full(len(taken), np.inf)
        step = GROWTH * taken * self._size
        return np.where((taken == 1.0) & ~self._truncated, np.maximum(self._radius, step), step)


@dataclass(frozen=True, eq=False)
class Pair:
    """A step s (3N, b) [m], the change y (3N, b) [N] of the free gradient along it, 1 / s.y (b,); 0 passes it by."""

    s: wp.array
    y: wp.array
    inverse: np.ndarray

    def keep(self, device: Device, columns: np.ndarray) -> Pair:
        """The pair of these columns (k,)."""
        return Pair(gathered(device, self.s, columns), gathered(device, self.y, columns), self.inverse[columns])


class LBFGS:
    """Limited-memory BFGS that starts from the inverse of the rest stiffness.

    Nocedal, Wright 2006, "Numerical Optimization", algorithm 7.4; one application of the preconditioner a step. Only
    pairs of positive curvature count: the direction always descends.
    """

    def __init__(self, preconditioner: Preconditioner, most: int = 8):
        self._preconditioner, self._most = preconditioner, most
        self.begin()

    def begin(self) -> None:
        """No pairs yet."""
        self._pairs: list[Pair] = []
        self._open: Pair | None = None

    def keep(self, device: Device, columns: np.ndarray) -> None:
        """Keep the pairs of these columns (k,)."""
        self._pairs = [pair.keep(device, columns) for pair in self._pairs]
        self._open = None if self._open is None else self._open.keep(device, columns)

    def find(
        self, problem: Problem, u: wp.array, g: wp.array, gap: wp.array | None, forcing: np.ndarray, taken: np.ndarray
    ) -> Direction:
        """As `Descent`; `forcing` has no meaning here."""
        device, columns = problem.device, u.shape[1]
        self._learn(device, g, taken)
        problem.linearise(u, taken == 0.0)
        self._preconditioner.prepare(problem, columns)
        rhs, pulled = right_hand_side(problem, g, gap)
        q, x = wp.clone(rhs), device.zeros(*g.shape)
        weights: list[np.ndarray] = []
        for pair in reversed(self._pairs):
            weights.append(pair.inverse * dots(device, pair.s, q))
            combined(device, q, -weights[-1], pair.y, q)
        self._preconditioner.apply(q, np.ones(columns, bool), x)
        problem.constraint.project(x)
        for pair, weight in zip(self._pairs, reversed(weights), strict=True):
            combined(device, x, weight - pair.inverse * dots(device, pair.y, x), pair.s, x)
        promised = dots(device, rhs, x)
        d = closing(device, x, gap)
        # A step that closes a gap leaves the free motions: its pair would say nothing of them.
        self._open = Pair(d, g, (~pulled).astype(np.float64))
        return Direction(d, promised, 1)

    def _learn(self, device: Device, g: wp.array, taken: np.ndarray) -> None:
        """Complete the open pair by the gradient g (3N, b); where nothing was taken, forget all pairs."""
        if self._open is None:
            return
        last = self._open
        s = combined(device, device.zeros(*g.shape), taken, last.s, wp.empty_like(g))
        y = combined(device, g, np.full(len(taken), -1.0), last.y, wp.empty_like(g))
        curvature = dots(device, s, y)
        least = LEAST_CURVATURE * norms(device, s) * norms(device, y)
        counts = (last.inverse != 0.0) & (curvature > least)
        inverse = np.divide(1.0, curvature, out=np.zeros_like(curvature), where=counts)
        known = [replace(pair, inverse=np.where(taken == 0.0, 0.0, pair.inverse)) for pair in self._pairs]
        self._pairs = [*known, Pair(s, y, inverse)][-self._most :]


def right_hand_side(problem: Problem, g: wp.array, gap: wp.array | None) -> tuple[wp.array, np.ndarray]:
    """-P (g + K gap) (3N, b) [N] at the last linearisation, and which columns (b,) have a gap to close."""
    device, columns = problem.device, g.shape[1]
    minus = np.full(columns, -1.0)
    rhs = combined(device, device.zeros(*g.shape), minus, g, wp.empty_like(g))
    if gap is None:
        return rhs, np.zeros(columns, bool)
    pull = device.zeros(*g.shape)
    problem.add_curvature(gap, pull)
    problem.constraint.project(pull)
    return combined(device, rhs, minus, pull, rhs), norms(device, gap) > 0.0


def closing(device: Device, x: wp.array, gap: wp.array | None) -> wp.array:
    """x (3N, b) and, if any, the motion that closes the constraints, in place."""
    return x if gap is None else combined(device, x, np.ones(x.shape[1]), gap, x)
