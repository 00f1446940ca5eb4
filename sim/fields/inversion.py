"""Inverse of a displacement field on a grid, for points outside the deformed mesh."""

from dataclasses import dataclass

import numpy as np

from .grid import Grid


@dataclass(frozen=True)
class InversionSettings:
    """Settings of `invert_field`."""

    tolerance: float = 1e-6  # tolerance [m]
    max_iterations: int = 25  # maximum iterations
    max_newton_step: float = 2.0  # maximum Newton step [spacings]
    max_change_ratio: float = 0.6  # Required contraction of fixed-point steps; points that miss it use Newton's method.


INVERSION = InversionSettings()


def invert_field(grid: Grid, forward: np.ndarray, points: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Return the solution d (n, 3) [m] of d = -forward(y + d) at points y (n, 3) [m], from the initial `guess` (n, 3).

    Most points converge by fixed-point iteration. The iteration diverges where tissue is sheared by more than 45
    degrees; these points are solved by Newton's method.
    """
    found, going, left = guess.copy(), np.arange(len(points)), []
    last = np.full(len(points), np.inf)
    for _ in range(INVERSION.max_iterations):
        new = -grid.interpolate(forward, points[going] + found[going])
        change = np.linalg.norm(new - found[going], axis=1)
        nearer = change < INVERSION.max_change_ratio * last[going]
        left.append(going[~nearer])
        found[going[nearer]], last[going[nearer]] = new[nearer], change[nearer]
        going = going[nearer & (change > INVERSION.tolerance)]
        if not len(going):
            break
    hard = np.concatenate([*left, going])
    found[hard] = invert_by_newton(grid, forward, points[hard], guess[hard])
    return found


def invert_by_newton(grid: Grid, forward: np.ndarray, points: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Return the result of `invert_field` by Newton's method; the best iterate for a point that does not converge."""
    best, least = guess.copy(), np.full(len(points), np.inf)
    trial, going, share = guess.copy(), np.arange(len(points)), np.ones(len(points))
    step = np.zeros_like(guess)
    for _ in range(INVERSION.max_iterations):
        at = points[going] + trial[going]
        rest = trial[going] + grid.interpolate(forward, at)
        size = np.linalg.norm(rest, axis=1)
        good = size < least[going]
        best[going[good]], least[going[good]] = trial[going[good]], size[good]
        share[going] = np.where(good, 1.0, 0.5 * share[going])  # halve a step that increased the residual
        fresh = going[good]
        step[fresh] = _compute_newton_step(grid, forward, points[fresh] + best[fresh], rest[good])
        going = going[least[going] > INVERSION.tolerance]
        if not len(going):
            break
        trial[going] = best[going] + share[going, None] * step[going]
    return best


def _compute_newton_step(grid: Grid, forward: np.ndarray, positions: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return the Newton steps (n, 3) [m] at `positions` (n, 3) [m] with `residuals` (n, 3)."""
    half, columns = 0.25 * grid.spacing, []
    for axis in np.eye(3):
        ahead, behind = (grid.interpolate(forward, positions + sign * half * axis) for sign in (1.0, -1.0))
        columns.append((ahead - behind) / (2.0 * half) + axis)
    matrix = np.stack(columns, axis=-1)
    flat = np.abs(np.linalg.det(matrix)) < 1e-3
    matrix[flat] = np.eye(3)
    step = -np.linalg.solve(matrix, residuals[..., None])[..., 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return step * np.minimum(1.0, INVERSION.max_newton_step * grid.spacing / np.maximum(length, 1e-30))
