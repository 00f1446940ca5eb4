"""Load histories in relaxing tissue: a tool is brought in and then held.

A load of a pose at a time [s] is such a history. The tool arrives within `APPROACH_TIME`, or within the time if that is
shorter, and stays in place until the time.
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
"""Description of the rows of such a data set."""
MIN_TIME = 0.05  # Smallest sampled time [s].
MAX_TIME = 100.0  # Largest sampled time [s].


def sample_times(count: int, seed: int) -> np.ndarray:
    """Sample times (count,) [s] of histories, uniform in their logarithm; time i does not depend on count.

    Scenes last a few seconds; slower relaxation matters for a tool that stays.
    """
    source = np.random.Generator(np.random.Philox(key=[seed, 1]))
    return MIN_TIME * (MAX_TIME / MIN_TIME) ** source.random(count)


def get_relaxation_series(effects: Iterable[Effect]) -> Pairs:
    """Return the Prony series of the effects' tissue; () if it does not relax."""
    defaults = (effect.default for effect in effects if isinstance(effect, Elasticity))
    return next((tissue.prony for tissue in defaults if tissue is not None), ())


def solve_histories(deformer: Deformer, loads: Loads) -> Deformation:
    """Solve histories of B loads: two time steps, of which the second is skipped while a tool still arrives.

    A tool without an equilibrium in the first step is not held further, and its result has that outcome.
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
    """Compute the remainder (B, n) of each coefficient g of a Prony series after histories of B durations [s].

    As in the FEM, a load that arrives within a time step acts for half of the step.
    """
    coming = np.minimum(times, APPROACH_TIME)
    g, tau = np.array(series).T
    return g * np.exp(-(times - 0.5 * coming)[:, None] / tau)


def read_prony_series(provenance: Mapping[str, str]) -> Pairs:
    """Read the Prony series of a data set of histories from its provenance; () for other data."""
    if "history" not in provenance or "tissue" not in provenance:
        return ()
    if provenance["history"] != HISTORY:
        raise InputError(f"unsupported histories ({provenance['history']}): simulate again.")
    return read_tissue_json(provenance["tissue"]).prony
