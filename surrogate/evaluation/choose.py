"""Selection of a deformer by error limit or time limit, and the Pareto front of error and time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim.errors import InputError


@dataclass(frozen=True)
class ModelCandidate:
    """Name of a deformer, its reported error [mm], the median time of one load [ms], and a remark on both."""

    name: str
    error_mm: float
    median_ms: float
    remark: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.error_mm:.3g} mm, {self.median_ms:.3g} ms{self.remark})"


@dataclass(frozen=True)
class ModelChoice:
    """Selected deformer, and a sentence with the reason."""

    candidate: ModelCandidate
    reason: str


def choose_model(
    candidates: Sequence[ModelCandidate], max_error_mm: float | None = None, max_time_ms: float | None = None
) -> ModelChoice:
    """Select the fastest deformer within an error limit; without one, the most accurate within a time limit.

    If both limits are given, both are satisfied.

    Raises
    ------
    InputError
        No deformer within the limits, or no limit; an error or a time that is not positive.
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


def _get_error(offer: ModelCandidate) -> tuple[float, float]:
    return offer.error_mm, offer.median_ms


def _get_time(offer: ModelCandidate) -> tuple[float, float]:
    return offer.median_ms, offer.error_mm


def find_pareto_front(points: Mapping[str, tuple[float, float]]) -> frozenset[str]:
    """Return the names on the Pareto front of two numbers (smaller is better), equals included."""
    return frozenset(
        name
        for name, (time, error) in points.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e in points.values())
    )
