"""A run planned on paper: time, disk and processes of many episodes, from those that were made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.errors import InputError

from .engine import BODY, EPISODE
from .rates import Rate

HOUR, DAY = 3600.0, 86400.0
PROCESSES = (1, 8, 64, 512)
"""For how many the time is printed."""


@dataclass(frozen=True)
class Amount:
    """A sum that is expected, and its standard error; the latter NaN where one was measured and no more."""

    mean: float
    error: float


@dataclass(frozen=True)
class Estimate:
    """What episodes will take of one process in all.

    Parameters
    ----------
    episodes, bodies
        That are asked for.
    measured, measured_bodies
        From which that is known.
    seconds, frames, bytes
        [s], frames, and bytes, of all episodes and their bodies.
    """

    episodes: int
    bodies: int
    measured: int
    measured_bodies: int
    seconds: Amount
    frames: Amount
    bytes: Amount


def estimated(rates: Sequence[Rate], episodes: int, bodies: int) -> Estimate:
    """What a number of episodes on a number of bodies will take, as those that were measured.

    Raises
    ------
    InputError
        Nothing that was measured.
    """
    own = {kind: [rate for rate in rates if rate.kind == kind] for kind in (EPISODE, BODY)}
    if not own[EPISODE]:
        raise InputError(
            "no episode was measured there: make some first, by the same command with --count 8 and without --estimate."
        )

    def amount(what: str, kinds: Sequence[str]) -> Amount:
        counts = {EPISODE: episodes, BODY: bodies}
        parts = [_sum([getattr(rate, what) for rate in own[kind]], counts[kind]) for kind in kinds if own[kind]]
        return Amount(sum(part.mean for part in parts), float(np.hypot.reduce([part.error for part in parts])))

    both = (EPISODE, BODY)
    return Estimate(
        episodes,
        bodies,
        len(own[EPISODE]),
        len(own[BODY]),
        amount("seconds", both),
        amount("frames", [EPISODE]),
        amount("bytes", both),
    )


def _sum(values: Sequence[float], count: int) -> Amount:
    """Of `count` as these, whose mean is known to its standard error only; exactly where all were measured."""
    if len(values) >= count:
        return Amount(count * float(np.mean(values)), 0.0)
    error = float(np.std(values, ddof=1)) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return Amount(count * float(np.mean(values)), count * error)


def lines(estimate: Estimate) -> list[str]:
    """A table of it."""
    found = estimate
    rows = [
        ("disk", _plus_minus(found.bytes, 1e9, "GB")),
        ("frames", _plus_minus(found.frames, 1e6, "million")),
        ("work of one process", _plus_minus(found.seconds, HOUR, "h")),
        *(
            (f"time of {count} process{'es' * (count > 1)}", _plus_minus(found.seconds, count * DAY, "days"))
            for count in PROCESSES
        ),
        ("processes for one day", f"{int(np.ceil(found.seconds.mean / DAY))}"),
    ]
    width = max(len(name) for name, _ in rows)
    bodies = f" and {found.measured_bodies} bodies" if found.measured_bodies else ", and no body"
    return [
        f"{found.episodes} episodes on {found.bodies} bodies, as measured of {found.measured} episodes{bodies}:",
        *(f"  {name:{width}}  {value}" for name, value in rows),
        "One process is a core, or a card. The margin is the standard error of the mean, times the count.",
    ]


def _plus_minus(amount: Amount, unit: float, word: str) -> str:
    margin = f"{amount.error / unit:.2g}" if np.isfinite(amount.error) else "not known"
    return f"{amount.mean / unit:.3g} ± {margin} {word}"
