"""Distributions of the numbers and words of a plan, and sampling of values from a seed."""

from dataclasses import dataclass
from zlib import crc32

import msgspec
import numpy as np

from sim.errors import InputError


class Distribution(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distribution of a number or a word; exactly one of `uniform`, `log`, `normal` and `choice` is given.

    Parameters
    ----------
    uniform, log
        Limits of a uniform or log-uniform distribution.
    normal
        Mean and standard deviation; values are clipped at three standard deviations.
    choice, weights
        Possible values, and their relative frequencies (default: equal).
    """

    uniform: tuple[float, float] | None = None
    log: tuple[float, float] | None = None
    normal: tuple[float, float] | None = None
    choice: list[float | str | bool] | None = None
    weights: list[float] | None = None


Number = float | tuple[float, float] | Distribution
"""Number of a plan: a fixed value; limits of a uniform distribution; or a `Distribution`."""
Word = str | list[str] | Distribution
"""Word of a plan: a fixed word; equally probable words; or a `Distribution`."""


@dataclass(frozen=True)
class ValueLimits:
    """Smallest and largest allowed value of a number in a plan, and their unit."""

    low: float
    high: float
    unit: str = "1"

    def __str__(self) -> str:
        """Format the limits with their unit."""
        return f"{self.low:,g} to {self.high:,g}" + (f" {self.unit}" if self.unit != "1" else "")


def build_generator(seed: int, number: int, name: str) -> np.random.Generator:
    """Build the random generator of a named quantity of episode `number`, independent of other names and episodes."""
    return np.random.default_rng([seed, number, crc32(name.encode())])


def to_distribution(value: object) -> Distribution:
    """Convert a value of a plan (`Number` or `Word`) to a `Distribution`."""
    if isinstance(value, Distribution):
        return value
    if isinstance(value, tuple):
        return Distribution(uniform=value)
    return Distribution(choice=list(value) if isinstance(value, list) else [value])  # type: ignore[list-item]


def sample_value(distribution: object, random: np.random.Generator) -> float | str | bool:
    """Sample a value from a `Number` or `Word` of a plan."""
    spread = to_distribution(distribution)
    if spread.uniform is not None:
        return float(random.uniform(*spread.uniform))
    if spread.log is not None:
        return float(np.exp(random.uniform(*np.log(spread.log))))
    if spread.normal is not None:
        mean, deviation = spread.normal
        return mean + deviation * float(np.clip(random.standard_normal(), -3.0, 3.0))
    assert spread.choice is not None
    weights = None if spread.weights is None else np.array(spread.weights) / np.sum(spread.weights)
    return spread.choice[int(random.choice(len(spread.choice), p=weights))]


def check_distribution(value: object, name: str, limits: ValueLimits | None, choices: tuple[str, ...] = ()) -> None:
    """Check that all values that can be sampled are valid.

    Parameters
    ----------
    limits
        Allowed range of numbers; None for words.
    choices
        Allowed words; empty: any word.

    Raises
    ------
    InputError
        A range is reversed or infinite, weights are invalid, a value is outside the limits, or a word is not in
        `choices`.
    """
    spread = to_distribution(value)
    given = [kind for kind in ("uniform", "log", "normal", "choice") if getattr(spread, kind) is not None]
    if len(given) != 1:
        said = " and ".join(given) or "none"
        raise InputError(f"{name}: give one of uniform, log, normal and choice, not {said}.")
    if spread.choice is not None:
        _check_choice(spread, name)
        values = spread.choice
    elif spread.normal is not None:
        mean, deviation = spread.normal
        if not deviation >= 0.0:
            raise InputError(f"{name}: a standard deviation of {deviation:g} is none: give 0 or more.")
        values = [mean - 3.0 * deviation, mean + 3.0 * deviation]
    else:
        low, high = values = list(spread.uniform or spread.log or ())
        if not low <= high:
            raise InputError(f"{name}: from {low:g} to {high:g} is upside down: give the least value first.")
        if spread.log is not None and not low > 0.0:
            raise InputError(f"{name}: a logarithmic range starts above 0, not at {low:g}.")
    for each in values:
        _check_value(each, name, limits, choices)


def _check_choice(distribution: Distribution, name: str) -> None:
    count, weights = len(distribution.choice or ()), distribution.weights
    if not count:
        raise InputError(f"{name}: there is nothing to choose from: give one value or more.")
    if weights is None:
        return
    if len(weights) != count:
        raise InputError(f"{name}: {len(weights)} weights for {count} values: give one for each.")
    if not (all(each >= 0.0 for each in weights) and 0.0 < sum(weights) < np.inf):
        raise InputError(f"{name}: weights {weights} are none: give numbers that are not below 0, and one above.")


def _check_value(value: float | str | bool, name: str, limits: ValueLimits | None, choices: tuple[str, ...]) -> None:
    if limits is None:
        if choices and value not in choices:
            raise InputError(f"{name}: {value!r} is not known: choose from {', '.join(map(str, choices))}.")
        return
    if isinstance(value, str | bool) or not limits.low <= value <= limits.high:
        raise InputError(f"{name}: {value!r} may be drawn, and {limits} is possible.")
