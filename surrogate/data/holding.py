"""Tools that are brought in and then held: how tissue that relaxes is asked, and how far it has relaxed by then.

A load of a pose at a time [s] is such a history. The tool comes within `BROUGHT`, or within the time if that is
shorter, and stays where it is until the time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from sim.deformation import Deformation, Deformer, joined
from sim.effects import Effect, Elasticity
from sim.errors import InputError
from sim.loads import Loads
from sim.material import Pairs, tissue_from_json

BROUGHT = 1.0
"""The longest that a tool takes to where it is held [s]."""
HISTORY = f"the tool came within {BROUGHT:g} s, or within the load's time if that is shorter, and stayed until then"
"""What the rows of such a data set are, in words."""
SOONEST, LATEST = 0.05, 100.0
"""Times that are drawn [s]."""


def drawn_times(count: int, seed: int) -> np.ndarray:
    """Times (count,) [s] at which histories are answered, uniform in their logarithm; time i does not depend on count.

    Every scene is over after a few seconds, and what relaxes more slowly is seen by a tool that stays.
    """
    source = np.random.Generator(np.random.Philox(key=[seed, 1]))
    return SOONEST * (LATEST / SOONEST) ** source.random(count)


def series_of(effects: Iterable[Effect]) -> Pairs:
    """The series by which the tissue of some effects relaxes; () if it does not."""
    defaults = (effect.default for effect in effects if isinstance(effect, Elasticity))
    return next((tissue.prony for tissue in defaults if tissue is not None), ())


def held(deformer: Deformer, loads: Loads) -> Deformation:
    """Answers to histories of B loads: two steps of time, of which the second is not taken where a tool still comes.

    A tool that the first finds no equilibrium for is held no further, and its answer says so.
    """
    first = deformer.deform(Loads(loads.causes, np.minimum(loads.times, BROUGHT)))
    stay = np.flatnonzero([good.good for good in first.outcome] & (loads.times > BROUGHT))
    if not len(stay):
        return replace(first, time=loads.times)
    last = deformer.deform(loads.rows(stay), start=first.rows(stay))
    row = np.arange(len(loads))
    row[stay] = len(loads) + np.arange(len(stay))
    return replace(joined([first, last]).rows(row), time=loads.times)


def unfaded(series: Pairs, times: np.ndarray) -> np.ndarray:
    """What is left (B, n) of each g of a series at the end of histories of B times [s].

    As the finite elements step: what comes within a step has been there for half of it.
    """
    coming = np.minimum(times, BROUGHT)
    g, tau = np.array(series).T
    return g * np.exp(-(times - 0.5 * coming)[:, None] / tau)


def stated_series(stated: Mapping[str, str]) -> Pairs:
    """The series by which the tissue of a data set of histories relaxes, as its file states it; () of others."""
    if "history" not in stated or "tissue" not in stated:
        return ()
    if stated["history"] != HISTORY:
        raise InputError(f"the histories here are others than this version knows ({stated['history']}): simulate anew.")
    return tissue_from_json(stated["tissue"]).prony
