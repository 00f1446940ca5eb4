"""Empirical coverage of a model's error bounds on loads that the model was not trained on."""

from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from sim.deformation import Deformation, Outcome
from sim.errors import InputError
from sim.loads import Loads

from ..data.encode import split_forces
from ..model.conformal import LEVELS
from ..model.learned import Learned

FORCE_CLASSES = 10  # Number of classes of force for which coverage is reported.
Shares = tuple[float | None, ...]
"""Share of loads with an error within the bound, for each of `conformal.LEVELS`; None for infinite bounds."""


@dataclass(frozen=True)
class Coverage:
    """Empirical coverage of a model's bounds over n loads, with median bound and error.

    Parameters
    ----------
    loads
        Number n of loads.
    shares
        Empirical coverage for each of `conformal.LEVELS`; None if too few calibration loads give no guarantee. The
        error is the maximum over the tumour, or the error of the tip-tumour distance.
    tenths
        Coverage at the first level by decile of the force, in ascending order.
    bound_mm, error_mm
        Medians over the loads [mm]: of the bound at the first level, and of the error.
    extrapolated
        Number of loads that the model marks as outside its training range.
    """

    loads: int
    shares: Shares
    tenths: tuple[float, ...]
    bound_mm: float
    error_mm: float
    extrapolated: int

    held = property(attrgetter("shares"))  # Former name, for one release.

    def __str__(self) -> str:
        tenths = " ".join(f"{100 * share:.0f}" for share in self.tenths)
        return (
            f"{format_coverage(self.shares)}; by decile of force {tenths}; median bound {self.bound_mm:.4f} mm, median "
            f"error {self.error_mm:.4f} mm; {self.extrapolated} loads outside the training range"
        )


def compute_coverage(model: Learned, loads: Loads, truth: np.ndarray) -> Coverage:
    """Compute the coverage of a model's bounds, given the tumour's FEM displacements `truth` (B, n, 3) [m].

    Raises
    ------
    InputError
        The model has no bounds, or there are fewer loads than deciles.
    """
    if model.bounds is None:
        raise InputError("this model has no calibrated bounds: train it on a data set with more loads.")
    _check_load_count(loads)
    result = model.deform(loads, at=model.anatomy.tumour_nodes)
    worst = np.linalg.norm(result.displacement - truth, axis=2).max(axis=1)
    return _measure_coverage(model, loads, result, worst, result.bound)


def measure_distance_coverage(model: Learned, loads: Loads, reference: np.ndarray) -> Coverage:
    """Compute the coverage of a model's distance bounds, given the FEM distances `reference` (B,) [m].

    Raises
    ------
    InputError
        The model has no bound of its distance, or there are fewer loads than deciles.
    """
    if model.tip is None or model.tip.bound is None:
        raise InputError("this model has no calibrated bound of its distance: train it again, with enough loads.")
    _check_load_count(loads)
    result = model.deform(loads, at=model.nodes)
    found = model.predict_distance(loads, result)
    return _measure_coverage(model, loads, result, np.abs(found.distance - reference), found.bound)


def _check_load_count(loads: Loads) -> None:
    if len(loads) < FORCE_CLASSES:
        raise InputError(f"{len(loads)} loads have no tenths: simulate at least {FORCE_CLASSES}.")


def measure_coverage_shares(error: np.ndarray, bounds: np.ndarray) -> Shares:
    """Compute the share of errors (B,) within `bounds` (levels, B) for each level; None if all bounds are infinite."""
    promised = ~np.isposinf(bounds)
    return tuple(
        float((error <= row)[some].mean()) if some.any() else None for row, some in zip(bounds, promised, strict=True)
    )


def format_coverage(fractions: Shares) -> str:
    """Format the empirical coverage at each level as text."""
    shares = zip(fractions, LEVELS, strict=True)
    return ", ".join(
        f"no guarantee at {100 * level:g} %" if share is None else f"{100 * share:.1f} % at {100 * level:g} %"
        for share, level in shares
    )


def measure_coverage(force: np.ndarray, error: np.ndarray, bounds: np.ndarray, extrapolated: int) -> Coverage:
    """Compute the coverage of errors (B,) [m] by bounds (2, B) [m], for all loads and by decile of force (B,) [N]."""
    covered = error <= bounds[0]
    by_force = np.array_split(np.argsort(force, kind="stable"), FORCE_CLASSES)
    return Coverage(
        len(error),
        measure_coverage_shares(error, bounds),
        tuple(float(covered[rows].mean()) for rows in by_force),
        1e3 * float(np.median(bounds[0])),
        1e3 * float(np.median(error)),
        extrapolated,
    )


def _measure_coverage(
    model: Learned, loads: Loads, result: Deformation, error: np.ndarray, bounds: np.ndarray
) -> Coverage:
    force = split_forces(model.to_input(loads))[0]
    return measure_coverage(force, error, bounds, result.outcome.count(Outcome.EXTRAPOLATED))
