"""Load histories in relaxing tissue: a tool moves to its pose, and then stays there.

A load that is a pose with a time [s] stands for such a history. The tool arrives within `APPROACH_TIME`, or within the
load's time if that is shorter, and stays in place until that time.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from sim.deformation import Deformation, Deformer, join_deformations
from sim.effects import Effect, Elasticity
from sim.errors import InputError
from sim.loads import Loads
from sim.material import Pairs, read_tissue_json

APPROACH_TIME = 1.0
"""Maximum time that a tool takes to arrive [s]."""
HISTORY = (
    f"the tool came within {APPROACH_TIME:g} s, or within the load's time if that is shorter, and stayed until then"
)
"""Description of the load histories of a data set, for its provenance."""
MIN_TIME = 0.05  # Smallest sampled time [s].
MAX_TIME = 100.0  # Largest sampled time [s].


def sample_times(count: int, seed: int) -> np.ndarray:
    """Sample log-uniform times (count,) [s] of load histories; time i does not depend on `count`.

    Scenes last a few seconds; the longer times are for tools that stay in place.
    """
    source = np.random.Generator(np.random.Philox(key=[seed, 1]))
    return MIN_TIME * (MAX_TIME / MIN_TIME) ** source.random(count)


def get_relaxation_series(effects: Iterable[Effect]) -> Pairs:
    """Return the Prony series of the tissue among the effects; () if the tissue does not relax."""
    defaults = (effect.default for effect in effects if isinstance(effect, Elasticity))
    return next((tissue.prony for tissue in defaults if tissue is not None), ())


def solve_histories(deformer: Deformer, loads: Loads) -> Deformation:
    """Solve the histories of B loads in two time steps: arrival and stay of the tool.

    The second step is skipped for tools that still arrive, or that have no equilibrium in the first step.
    """
    first = deformer.deform(Loads(loads.causes, np.minimum(loads.times, APPROACH_TIME)))
    stay = np.flatnonzero([good.good for good in first.outcome] & (loads.times > APPROACH_TIME))
    if not len(stay):
        return replace(first, time=loads.times)
    last = deformer.deform(loads.select(stay), start=first.select(stay))
    row = np.arange(len(loads))
    row[stay] = len(loads) + np.arange(len(stay))
    return replace(join_deformations([first, last]).select(row), time=loads.times)


def compute_decayed_coefficients(series: Pairs, times: np.ndarray) -> np.ndarray:
    """Compute the decayed coefficients (B, n) of a Prony series of n pairs, after histories of B durations [s].

    As in FEM, a load that arrives during a time step acts for half of the step.
    """
    coming = np.minimum(times, APPROACH_TIME)
    g, tau = np.array(series).T
    return g * np.exp(-(times - 0.5 * coming)[:, None] / tau)


def read_prony_series(provenance: Mapping[str, str]) -> Pairs:
    """Read the Prony series from the provenance of a data set of histories; return () for other data."""
    if "history" not in provenance or "tissue" not in provenance:
        return ()
    if provenance["history"] != HISTORY:
        raise InputError(f"unsupported histories ({provenance['history']}): simulate again.")
    return read_tissue_json(provenance["tissue"]).prony
