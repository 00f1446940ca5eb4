"""Estimate of time, disk space and processes that many episodes need, from measured episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim.errors import InputError

from .engine import BODY, EPISODE
from .rates import TaskRate
from .tasks import FIRST, FIRST_OF_BODY, FIRST_OF_PROCESS, NOT_FIRST

DAY = 86400.0  # One day [s].
UNITS = (DAY, "days"), (3600.0, "h"), (60.0, "min")
"""Units of printed times [s], the longest unit first; a unit is used for times of at least 2 units."""
PROCESS_COUNTS = (1, 8, 64, 512)
"""Numbers of processes for which the time is printed."""


@dataclass(frozen=True)
class Estimate:
    """Estimated mean or total with its standard error, which is NaN if only one value was measured."""

    mean: float
    error: float


@dataclass(frozen=True)
class RunEstimate:
    """Estimated cost of a run.

    Parameters
    ----------
    episodes, bodies
        Requested numbers of episodes and bodies.
    measured, measured_bodies
        Numbers of measured episodes and bodies on which the estimate is based.
    seconds, frames, bytes
        Totals of all episodes and bodies: computing time of a single process [s], number of frames, and size.
    start, opening
        Extra time [s] of a process's first episode, for loading and compiling, and of its first episode on each
        further body. NaN: not available.
    apart
        True if `seconds` exclude the extra time of first episodes; False if the time is included.
    """

    episodes: int
    bodies: int
    measured: int
    measured_bodies: int
    seconds: Estimate
    frames: Estimate
    bytes: Estimate
    start: Estimate
    opening: Estimate
    apart: bool

    def estimate_duration(self, processes: int) -> Estimate:
        """Return the estimated duration [s] of the run with a number of processes."""
        each = self.episodes / processes
        further = self.bodies * -np.expm1(-each / self.bodies) - 1.0  # bodies that the episodes of one process use
        parts = (self.start, 1.0), (self.opening, max(0.0, further)), (self.seconds, 1.0 / processes)
        return _add_amounts([Estimate(part.mean * by, part.error * by) for part, by in parts if np.isfinite(part.mean)])


def compute_estimate(rates: Sequence[TaskRate], episodes: int, bodies: int) -> RunEstimate:
    """Estimate the cost of `episodes` episodes on `bodies` bodies from measured `rates`.

    Raises
    ------
    InputError
        No episode was measured.
    """
    own = {kind: [rate for rate in rates if rate.kind == kind] for kind in (EPISODE, BODY)}
    if not own[EPISODE]:
        raise InputError(
            "no episode was measured there: make some first, by the same command with --count 8 and without --estimate."
        )
    counts = {EPISODE: episodes, BODY: bodies}
    by = {first: [rate for rate in own[EPISODE] if rate.first == first] for first in FIRST}
    apart = len(by[NOT_FIRST]) > 1

    def estimate_total(name: str, rates: Mapping[str, Sequence[TaskRate]]) -> Estimate:
        return _add_amounts(
            [_compute_total([getattr(one, name) for one in rates[kind]], counts[kind]) for kind in rates if rates[kind]]
        )

    return RunEstimate(
        episodes=episodes, bodies=bodies, measured=len(own[EPISODE]), measured_bodies=len(own[BODY]),
        seconds=estimate_total("seconds", {**own, EPISODE: by[NOT_FIRST] if apart else own[EPISODE]}),
        frames=estimate_total("frames", {EPISODE: own[EPISODE]}),
        bytes=estimate_total("bytes", own),
        start=_compute_extra_time(by[FIRST_OF_PROCESS], by[NOT_FIRST] if apart else []),
        opening=_compute_extra_time(by[FIRST_OF_BODY], by[NOT_FIRST] if apart else []),
        apart=apart,
    )  # fmt: skip


def _compute_extra_time(first_rates: Sequence[TaskRate], later_rates: Sequence[TaskRate]) -> Estimate:
    """Return the mean extra time of first episodes [s]; with a single measurement, the error is the extra time."""
    if not (first_rates and later_rates):
        return Estimate(np.nan, np.nan)
    one, other = (_compute_mean([rate.seconds for rate in those]) for those in (first_rates, later_rates))
    longer, error = max(0.0, one.mean - other.mean), float(np.hypot(one.error, other.error))
    return Estimate(longer, error if np.isfinite(error) else longer)


def _compute_mean(values: Sequence[float]) -> Estimate:
    """Return the mean of values and its standard error."""
    error = float(np.std(values, ddof=1)) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return Estimate(float(np.mean(values)), error)


def _compute_total(values: Sequence[float], count: int) -> Estimate:
    """Return the estimated total of `count` values and its standard error, which is 0 if all were measured."""
    mean = _compute_mean(values)
    return Estimate(count * mean.mean, 0.0 if len(values) >= count else count * mean.error)


def _add_amounts(amounts: Sequence[Estimate]) -> Estimate:
    """Return the sum of independent amounts, with its standard error."""
    return Estimate(sum(one.mean for one in amounts), float(np.hypot.reduce([one.error for one in amounts])))


def format_estimate(estimate: RunEstimate) -> list[str]:
    """Format the estimate as the lines of a table."""
    found = estimate
    rows = [
        ("disk", _format_amount(found.bytes, 1e9, "GB")),
        ("frames", _format_amount(found.frames, 1e6, "million")),
        ("work of one process", _format_time(found.seconds)),
        ("start of a process", _format_time(found.start)),
        ("its first on a body", _format_time(found.opening)),
        *(
            (f"time of {count} process{'es' * (count > 1)}", _format_time(found.estimate_duration(count)))
            for count in PROCESS_COUNTS
        ),
        ("processes for one day", f"{int(np.ceil(found.seconds.mean / DAY))}"),
    ]
    width = max(len(name) for name, _ in rows)
    bodies = f" and {found.measured_bodies} bodies" if found.measured_bodies else ", and no body"
    said = [
        f"{found.episodes} episodes on {found.bodies} bodies, as measured of {found.measured} episodes{bodies}:",
        *(f"  {name:{width}}  {value}" for name, value in rows),
        "The margin is the standard error of the mean, times the count. Processes are taken to be as fast as those "
        "that were measured.",
    ]
    if not found.apart:
        said.append(
            "Nearly all of these were their process's first on their body, which take longer: the times are too long. "
            f"Make {2 * found.measured} or more for better ones."
        )
    return said


def _format_time(amount: Estimate) -> str:
    unit, word = next((each for each in UNITS if amount.mean >= 2.0 * each[0]), (1.0, "s"))
    return _format_amount(amount, unit, word)


def _format_amount(amount: Estimate, unit: float, symbol: str) -> str:
    if not np.isfinite(amount.mean):
        return "not known"
    margin = f"{amount.error / unit:.2g}" if np.isfinite(amount.error) else "not known"
    return f"{amount.mean / unit:.3g} ± {margin} {symbol}"
