"""Row of a trained model: training without held-out discs, without held-out sectors, and with fewer loads."""

from dataclasses import dataclass, replace

import numpy as np

from sim.deformation import Deformer, Outcome
from sim.loads import Loads
from surrogate.data.splits import DiscSplit, hold_out_sectors
from surrogate.evaluation.coverage import FORCE_CLASSES, compute_coverage
from surrogate.evaluation.score import SolveCounts, time_single_loads
from surrogate.training.train import train

from ..analysis.measurement import time_work
from .adaptation import build_debulked_study, read_simulation_seconds
from .reference import get_solutions_beyond
from .row import ErrorFigures, ReportRow, compare_with_reference, compute_figures, compute_load_errors, summarise_times
from .study import ReportStudy, measure_series_seconds

MIN_LOADS = 64  # Smallest number of training loads of a learning curve.


@dataclass(frozen=True)
class LearnerSpec:
    """Model type of `train.LEARNERS`."""

    name: str


def measure_learner(study: ReportStudy, spec: LearnerSpec) -> ReportRow:
    """Train a model of this type, and measure errors, coverage and times as a row of the report.

    Raises
    ------
    InputError
        Input that `train` rejects.
    """
    nodes, truth = study.anatomy.tumour_nodes, study.data_displacement

    def judged(model: Deformer, split: DiscSplit) -> tuple[ErrorFigures | None, float]:
        """Return errors relative to the data set's solutions of the held-out loads, and the extrapolated share."""
        rows = np.flatnonzero(split.test_mask)
        return _compute_errors(model, study.converged.select(rows), truth[rows], nodes)

    discs, beyond = study.disc_split, get_solutions_beyond(study)
    (model, solves), learning = time_work(_train_model, study, spec, discs)
    outside, outside_truth = study.loads_beyond.select(np.flatnonzero(beyond.good)), beyond.displacement[beyond.good]
    sets = {"discs": judged(model, discs), "beyond": _compute_errors(model, outside, outside_truth, nodes)}
    curve, covered = [], {}
    if study.thorough:
        sectors = hold_out_sectors(study.pushed, study.patch)
        sets["sectors"] = judged(_train_model(study, spec, sectors)[0], sectors)
        covered = compute_coverage_beyond(study, spec, outside, outside_truth)
        order = np.flatnonzero(discs.training_mask)
        for count in list_counts(len(order)):
            left_aside = np.isin(np.arange(len(discs.disc_index)), order[count:])
            fewer = replace(discs, disc_index=np.where(left_aside, -2, discs.disc_index))
            curve.append((count, judged(_train_model(study, spec, fewer)[0], discs)[0]))
        curve.append((len(order), sets["discs"][0]))
    field, together = time_work(lambda: model.deform(study.test_loads, at=nodes).displacement)
    adapt, adapted = _measure_adaptation(study, spec)
    held_out = study.converged.select(np.flatnonzero(discs.test_mask))
    return ReportRow(
        spec.name,
        "trained models",
        reference=compare_with_reference(study, field, np.ones(len(field), bool), nodes),
        **compute_load_errors(study, field, np.ones(len(field), bool), nodes),
        own_fem={name: figures for name, (figures, _) in sets.items() if figures is not None},
        flagged={name: share for name, (_, share) in sets.items()},
        covered=covered,
        loads=solves.loads,
        units=solves.units,
        series=solves.series,
        inside=solves.inside,
        batch_ms=1e3 * together / len(field),
        solving=solves.seconds,
        learning=learning,
        adapt=adapt,
        adapted=adapted,
        command=f"sulcus train DATA.h5 --learners {spec.name} --out MODEL.npz",
        curve=tuple((count, each) for count, each in curve if each is not None),
        **summarise_times(time_single_loads(model, held_out, nodes, study.timed)),
    )


def list_counts(max_loads: int) -> list[int]:
    """List the counts 64, 128, 256, ... below `max_loads`."""
    return [MIN_LOADS << k for k in range(20) if MIN_LOADS << k < max_loads]


def compute_coverage_beyond(
    study: ReportStudy, spec: LearnerSpec, outside: Loads, reference: np.ndarray
) -> dict[str, float]:
    """Return the coverage of 95 % bounds on held-out discs and on loads `outside` (FEM: `reference` (B, n, 3) [m])."""
    trained = train(study.dataset, [spec.name], expansion=study.expansion)
    model, found = trained.models[spec.name], trained.held_out_coverage.get(spec.name)
    shares = {} if found is None else {"discs": found.shares[0]}
    if model.bounds is not None and len(outside) >= FORCE_CLASSES:
        shares["beyond"] = compute_coverage(model, outside, reference).shares[0]
    return {name: share for name, share in shares.items() if share is not None}


def _measure_adaptation(study: ReportStudy, spec: LearnerSpec) -> tuple[float | None, ErrorFigures | None]:
    """Return the adaptation time [s] to the debulked anatomy, and the errors there; both None without simulation."""
    seconds = read_simulation_seconds(study)
    if seconds is None:
        return None, None
    after = build_debulked_study(study)
    (model, _), learning = time_work(_train_model, after, spec, after.disc_split)
    rows = np.flatnonzero(after.disc_split.test_mask)
    seconds += learning + measure_series_seconds(after, spec.name)
    return seconds, _compute_errors(
        model, after.converged.select(rows), after.data_displacement[rows], after.anatomy.tumour_nodes
    )[0]


def _train_model(study: ReportStudy, spec: LearnerSpec, split: DiscSplit) -> tuple[Deformer, SolveCounts]:
    """Train a model on the training loads of a split; return the model and the numbers of FEM solves used."""
    trained = train(study.dataset, [spec.name], split=split, expansion=study.expansion)
    solves = trained.scores[0].solves
    assert solves is not None
    return trained.models[spec.name], solves


def _compute_errors(
    model: Deformer, loads: Loads, truth: np.ndarray, nodes: np.ndarray
) -> tuple[ErrorFigures | None, float]:
    """Compute errors relative to `truth` (B, k, 3) [m], and the share of loads that the model marks as extrapolated."""
    result = model.deform(loads, at=nodes)
    flagged = [outcome is Outcome.EXTRAPOLATED for outcome in result.outcome]
    return compute_figures(result.displacement, truth, loads), float(np.mean(flagged)) if flagged else 0.0
