"""A row of a learner: taught without the discs, without the sectors, and with ever fewer loads."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, replace

import numpy as np

from sim.deformation import Outcome
from sim.loads import Loads
from surrogate.learned import Learned
from surrogate.sectors import leave_sectors_out
from surrogate.split import Split
from surrogate.train import train

from .report_reference import beyond_of
from .report_row import Figures, Row, against_reference, figures_between, of_times
from .report_study import Study

WARM_UP, FEWEST_TAUGHT = 20, 64


@dataclass(frozen=True)
class Learner:
    """One of `surrogate.train.LEARNERS`."""

    name: str


def measure_learner(study: Study, spec: Learner) -> tuple[Row, np.ndarray]:
    """The row, and displacements (n, k, 3) [m] of the tumour's vertices under the played loads.

    Raises
    ------
    InputError
        What `train` refuses.
    """
    discs, sectors = study.discs, leave_sectors_out(study.pushed, study.patch)
    begun = clock.perf_counter()
    model = _taught(study, spec, discs)
    learning = clock.perf_counter() - begun
    order = np.flatnonzero(discs.taught)
    curve = []
    for count in counts(len(order)):
        left_aside = np.isin(np.arange(len(discs.disc)), order[count:])
        fewer = replace(discs, disc=np.where(left_aside, -2, discs.disc))
        curve.append((count, _judged(study, _taught(study, spec, fewer), discs)[0]))
    of_discs, of_sectors = _judged(study, model, discs), _judged(study, _taught(study, spec, sectors), sectors)
    beyond = beyond_of(study)
    outside = study.outside.rows(np.flatnonzero(beyond.good))
    sets = {
        "discs": of_discs,
        "sectors": of_sectors,
        "beyond": _held(study, model, outside, beyond.displacement[beyond.good]),
    }
    field = model.deform(study.played, at=study.anatomy.tumour_nodes).displacement
    row = Row(
        spec.name,
        "learnt",
        reference=against_reference(study, field, np.ones(len(field), bool)),
        teacher={name: figures for name, (figures, _) in sets.items() if figures is not None},
        flagged={name: share for name, (_, share) in sets.items()},
        taught=len(order),
        units=len(study.dataset.unit_good),
        learning=learning,
        curve=tuple((count, each) for count, each in [*curve, (len(order), of_discs[0])] if each is not None),
        **of_times(_single(study, model)),
    )
    return row, field


def counts(most: int) -> list[int]:
    """64, 128, 256, ... below `most`."""
    return [FEWEST_TAUGHT << k for k in range(20) if FEWEST_TAUGHT << k < most]


def _taught(study: Study, spec: Learner, split: Split) -> Learned:
    return train(study.dataset, [spec.name], split=split).models[spec.name]


def _judged(study: Study, model: Learned, split: Split) -> tuple[Figures | None, float]:
    """Against the data's own answers to the loads that a split leaves out."""
    rows = np.flatnonzero(split.test)
    return _held(study, model, study.converged.rows(rows), study.answers[rows])


def _held(study: Study, model: Learned, loads: Loads, truth: np.ndarray) -> tuple[Figures | None, float]:
    """Figures against `truth` (B, n, 3) [m], and the share of the loads that the model calls extrapolated."""
    answer = model.deform(loads, at=study.anatomy.tumour_nodes)
    flagged = [outcome is Outcome.EXTRAPOLATED for outcome in answer.outcome]
    return figures_between(answer.displacement, truth, loads), float(np.mean(flagged)) if flagged else 0.0


def _single(study: Study, model: Learned) -> list[float]:
    """Seconds of single loads of the discs, over and over again."""
    rows = np.flatnonzero(study.discs.test)
    single = [study.converged.rows(rows[k : k + 1]) for k in np.arange(WARM_UP + study.timed) % len(rows)]
    seconds = []
    for one in single:
        begun = clock.perf_counter()
        model.deform(one, at=study.anatomy.tumour_nodes)
        seconds.append(clock.perf_counter() - begun)
    return seconds[WARM_UP:]
