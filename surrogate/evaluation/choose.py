"""Selection of a deformer by an error limit or a time limit, and the Pareto front of error and time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim.errors import InputError


@dataclass(frozen=True)
class ModelCandidate:
    """Deformer to choose from: name, reported error [mm], median time of one load [ms], and a remark on both."""

    name: str
    error_mm: float
    median_ms: float
    remark: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.error_mm:.3g} mm, {self.median_ms:.3g} ms{self.remark})"


@dataclass(frozen=True)
class ModelChoice:
    """Selected deformer, and the reason for the selection as a sentence."""

    candidate: ModelCandidate
    reason: str


def choose_model(
    candidates: Sequence[ModelCandidate], max_error_mm: float | None = None, max_time_ms: float | None = None
) -> ModelChoice:
    """Select the fastest deformer within an error limit or, without one, the most accurate within a time limit.

    If both limits are given, the selected deformer is the fastest that satisfies both.

    Raises
    ------
    InputError
        No deformer satisfies the limits, no limit is given, or a limit is not positive.
    """
    given = {"mm": max_error_mm, "ms": max_time_ms}
    bounds = [f"{bound:g} {unit}" for unit, bound in given.items() if bound is not None]
    if not bounds or any(bound is not None and not bound > 0.0 for bound in given.values()):
        raise InputError(
            f"no deformer can be chosen within {' and '.join(bounds) or 'no bound'}: give --within-error, "
            "--within-time or both, positive."
        )
    exact = [offer for offer in candidates if max_error_mm is None or offer.error_mm <= max_error_mm]
    fast = [offer for offer in candidates if max_time_ms is None or offer.median_ms <= max_time_ms]
    both = [offer for offer in exact if offer in fast]
    asked = " and ".join(bounds)
    if not both:
        near = [f"the most accurate is {min(fast or candidates, key=_get_error)}"] if max_error_mm is not None else []
        near += [f"the fastest is {min(exact or candidates, key=_get_time)}"] if max_time_ms is not None else []
        raise InputError(f"no deformer here is within {asked}: {'; '.join(near)}. Allow more.")
    taken, word = (
        (min(both, key=_get_error), "most accurate") if max_error_mm is None else (min(both, key=_get_time), "fastest")
    )
    return ModelChoice(
        taken, f"{taken} is the {word} of {len(both)} deformers within {asked}, of {len(candidates)} here"
    )


def _get_error(candidate: ModelCandidate) -> tuple[float, float]:
    return candidate.error_mm, candidate.median_ms


def _get_time(candidate: ModelCandidate) -> tuple[float, float]:
    return candidate.median_ms, candidate.error_mm


def find_pareto_front(points: Mapping[str, tuple[float, float]]) -> frozenset[str]:
    """Return the names of the points on the Pareto front of (time, error), equal points included; smaller is better."""
    return frozenset(
        name
        for name, (time, error) in points.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e in points.values())
    )
