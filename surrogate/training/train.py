"""From a data set to models, their scores, and what they promise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.bodies.tip_distance import tip_gauge
from sim.errors import InputError
from sim.loads import Loads, Pushed, rows_of
from sim.runtime.timing import stage

from ..data.cortex_patch import Patch
from ..data.dataset import Dataset
from ..data.disc_split import APART, MOST_APART, Split, leave_discs_out
from ..data.holding import stated_series
from ..data.indentation import indented, with_relaxed
from ..evaluation.coverage import TENTHS, Coverage
from ..evaluation.force_score import ForceScore, force_errors, force_score
from ..evaluation.score import Score, errors, score
from ..model.conformal import LEVELS, USUAL_GROWTH, conformal
from ..model.learned import Learned, only_pushed
from ..model.left_out import left_out_of
from ..model.own_learners import OWN, find_own
from ..model.relaxation import followed
from ..model.tip_distance import TipModel
from ..model.training_range import envelope_of
from .bounds import FORCE, TIP, TUMOUR, Missed, bound_by, bounds_on_discs, covered_by, growth_by, missed
from .examples import Examples
from .expansion import EXPANDED, TOUCHED, Expansion
from .learners import LEARNT, POSED, force_of, parts_of
from .shared_inputs import SharedInputs
from .tip_distance import Measured, corrected_if_better, distance_errors, with_correction

# Of pushes, and of poses.
LEARNERS = ("linear", *LEARNT, *EXPANDED)
OF_POSES = (*TOUCHED, *POSED)
# Fewer could not promise 95 in 100.
FEWEST_APART = 19
# Of the errors at the tumour, and of the distance to it.
WAYS = (TUMOUR, TIP)


@dataclass(frozen=True, eq=False)
class Trained:
    """Models by learner, how they scored on the discs left out, and what those were.

    `motion` is the mean displacement [m] of the tumour over the held-out loads. `calibrated` counts the loads that
    calibrated the models' bounds, and the field after it counts the training loads. `left_out` gives by learner how
    often bounds held on the discs left out. These are bounds of the scored model, from loads outside the discs. By how
    much they grow with the distance from training loads, the other discs tell. `distance_left_out` gives the same
    for the distance from tip to tumour, and `force` how well the tool's force was known there, of poses whose
    data has it.
    """

    models: dict[str, Learned]
    scores: tuple[Score, ...]
    split: Split
    motion: float
    calibrated: int
    training_loads: int
    left_out: dict[str, Coverage]
    distance_left_out: dict[str, Coverage]
    force: dict[str, ForceScore]


def learners_for(data: Dataset) -> tuple[str, ...]:
    """All learners that a data set can train: series and contact need finite elements of a stated tissue."""
    stated = "tissue" in data.provenance
    kinds = LEARNERS if data.tool is None else OF_POSES
    return tuple(name for name in kinds if stated or name not in (*EXPANDED, *TOUCHED))


def check_learners(names: Sequence[str], of_poses: bool, where: str) -> None:
    """Refuse learners that data of pushes, or of poses, cannot train. `where` names the data in the sentence.

    Raises
    ------
    InputError
        No name, an unknown one, or one of the other kind of data.
    """
    kinds, others, held = (OF_POSES, LEARNERS, "poses") if of_poses else (LEARNERS, OF_POSES, "pushes")
    unknown = [name for name in names if name not in (*kinds, *others) and find_own(name) is None]
    if unknown or not names:
        allowed = ", ".join((*kinds, *OWN))
        raise InputError(
            f"no learner is called {', '.join(unknown) or 'nothing'}: choose from {allowed}; "
            "a file with one of your own is named by --plugin."
        )
    strange = [name for name in names if name in others and name not in kinds]
    if strange:
        raise InputError(
            f"{where}: holds {held}, of which {', '.join(strange)} cannot be had: choose from {', '.join(kinds)}."
        )


def train(
    data: Dataset,
    learners: Sequence[str] | None = None,
    progress: Callable[[str], object] = lambda learner: None,
    split: Split | None = None,
    most: int | None = None,
    expansion: Expansion | None = None,
) -> Trained:
    """Fit `learners`, by default all that the data can train: first to be scored, then to be used.

    Scored models are trained outside discs of the cortex, and scored inside. Those returned are trained on all
    those loads; their bounds are calibrated on others, which no fit has seen. Another `split`, with a row for each
    load that converged, calibrates nothing and returns what was trained on it.

    Every model knows the tumour and the open cortex; the cortex is not scored, and the compliance table's where the
    learner is not one of `EXPANDED`. Cases that did not converge are left aside.

    Parameters
    ----------
    progress
        Hears the name of each learner that is done.
    most
        Training loads, at most; those that calibrate or test are not counted.
    expansion
        The series of these data, by default made anew wherever there is a device: minutes on a CPU, so that whoever
        trains on them again hands it on.

    Raises
    ------
    InputError
        Unknown learners, or such as loads of the data's kind do not train; nothing to train on. Data with other causes
        than `Pushed` or the `Touching` of one tool, an anatomy without tumour, too few loads, or unit responses that
        did not converge.
    """
    wanted = learners_for(data) if learners is None else tuple(dict.fromkeys(learners))
    check_learners(wanted, of_poses=data.tool is not None, where=str(data.path))
    if most is not None and most < 1:
        raise InputError(f"{most} loads train nothing: give at least 1.")
    if not data.unit_good.all():
        raise InputError(
            f"{data.path}: {int((~data.unit_good).sum())} unit responses did not converge, so there is no compliance "
            "table: simulate anew with a looser --tolerance."
        )
    loads = data.loads.rows(np.flatnonzero(data.good))
    shared = expansion or Expansion(data)
    patch, nodes = shared.patch, shared.tumour
    pushed = _asked(data, loads, patch)
    if not len(nodes):
        raise InputError(f"{data.path}: its anatomy has no tumour to predict: make one that has.")
    apart = np.zeros(len(loads), bool)
    if split is None:
        apart[len(loads) - min(len(loads) // APART, MOST_APART) :] = True
        split = _without(leave_discs_out(pushed.point[~apart], patch), apart)
    with stage("read"):
        truth = data.displacement(nodes)[data.good]
        motion = np.linalg.norm(truth, axis=2).mean(axis=1)
        cortex = data.displacement(shared.cortex)[data.good]
        at = np.concatenate([nodes, shared.cortex])
        both = np.concatenate([truth, cortex], axis=1)
        distances = Measured(loads, tip_gauge(data.anatomy).distances(loads, both, at, data.tool))

    reaction = None if data.tool is None else data.reaction()
    exerted = None if reaction is None else reaction[data.good, 0, :3]
    ways = (*WAYS, FORCE) if exerted is not None else WAYS

    def examples(rows: np.ndarray) -> Examples:
        return Examples(rows_of(pushed, rows), truth[rows], cortex[rows], None if exerted is None else exerted[rows])

    def forces_off(model: Learned, rows: np.ndarray) -> list[Missed]:
        """How far a model is off in its tool's force on the chosen rows (B,) bool, if that is known: one, or none."""
        if exerted is None:
            return []
        asked = rows_of(pushed, rows)
        return [missed(model, patch, asked, force_errors(model.exerted(asked), exerted[rows]))]

    def unseen(model: Learned, rows: np.ndarray) -> list[Missed]:
        """How far a model is off at the tumour, in its distance, and in its force, on the chosen rows (B,) bool."""
        some, asked, known = np.flatnonzero(rows), rows_of(pushed, rows), distances.rows(rows)
        of_tumour = errors(model, loads.rows(some), truth[rows], nodes).max(axis=1)
        of_tip = distance_errors(model, known)
        both = [missed(model, patch, asked, error) for error in (of_tumour, of_tip)]
        return both + forces_off(model, rows)

    chosen = [_first(split.train, most), *([_first(~apart, most)] if apart.any() else [])]
    example_sets = [examples(rows) for rows in chosen]
    inputs = [SharedInputs(each, shared, left) for each, left in zip(example_sets, (split, None), strict=False)]
    test = loads.rows(np.flatnonzero(split.test))
    beside = apart & ~split.covers(pushed.point)
    envelopes = [envelope_of(patch, each.loads) for each in example_sets]
    models, scores, left_out, distance_left_out, force = {}, [], {}, {}, {}
    for name in wanted:
        with stage(f"learn {name}"):
            parts = parts_of(name, inputs[0], example_sets[0])
            model = Learned(
                data.anatomy,
                parts,
                envelopes[0],
                training={"learner": name, **data.provenance},
                tool=data.tool,
                force=force_of(name, parts, patch, example_sets[0]),
            )
        with stage("score"):
            solves = inputs[0].solve_counts(name, example_sets[0])
            scores.append(score(name, model, test, truth[split.test], nodes, solves))
            distance = errors(model, test, truth[split.test], nodes)
            error = distance.max(axis=1)
            model, off = corrected_if_better(model, patch, distances.rows(chosen[0]), distances.rows(split.test))
            tested = rows_of(pushed, split.test)
            far = [missed(model, patch, tested, each) for each in (error, off)] + forces_off(model, split.test)
        models[name] = replace(model, bound=min(conformal(far[0].error, LEVELS[0]), float(far[0].error.max())))
        growth, promised = [USUAL_GROWTH] * len(ways), None
        if beside.sum() >= 2 * FEWEST_APART and len(test) >= TENTHS:
            with stage("calibrate"):
                near = unseen(model, beside)
                every = list(zip(near, far, ways, strict=True))
                growth = [growth_by(here, there, way) for here, there, way in every]
                bound = [bounds_on_discs(model, here, there, split, way) for here, there, way in every]
                left_out[name], distance_left_out[name] = map(covered_by, bound[: len(WAYS)], far)
                alone = left_out_of(distance, motion[split.test], bound[0][0], far[0].extrapolated)
                models[name] = replace(models[name], left_out=alone)
                promised = bound[-1] if exerted is not None else None
        if exerted is not None:
            force[name] = force_score(far[-1].error, exerted[split.test], promised)
        if apart.any():
            with stage(f"learn {name}"):
                parts = parts_of(name, inputs[1], example_sets[1])
                of_force = force_of(name, parts, patch, example_sets[1])
                models[name] = replace(models[name], parts=parts, envelope=envelopes[1], force=of_force)
                if model.tip is not None and model.tip.correction is not None:
                    models[name] = with_correction(models[name], patch, distances.rows(chosen[1]))
        if apart.sum() >= FEWEST_APART:
            with stage("calibrate"):
                used = models[name]
                each = zip(unseen(used, apart), ways, growth, far, strict=True)
                bounds, tip, *of_force = (bound_by(near, way, grown, seen) for near, way, grown, seen in each)
                models[name] = replace(used, bounds=bounds, tip=replace(used.tip or TipModel(), bound=tip))
                if used.force is not None:
                    models[name] = replace(models[name], force=replace(used.force, bound=of_force[0]))
        progress(name)
    return Trained(
        models,
        tuple(scores),
        split,
        float(motion[split.test].mean()),
        int(apart.sum()),
        len(example_sets[-1].loads.point),
        left_out,
        distance_left_out,
        force,
    )


def _first(rows: np.ndarray, most: int | None) -> np.ndarray:
    """The first `most` of the chosen rows (B,) bool."""
    return rows if most is None else rows & (np.cumsum(rows) <= most)


def _without(split: Split, apart: np.ndarray) -> Split:
    """A split of the rows that are not `apart` (B,), as one of all rows."""
    disc = np.full(len(apart), -2)
    disc[~apart] = split.disc
    return replace(split, disc=disc)


def _asked(data: Dataset, loads: Loads, patch: Patch) -> Pushed:
    """What loads of a data set ask of a model, as `Learned.asked` has it."""
    if data.tool is not None:
        pushed, series = indented(loads, data.tool, patch), stated_series(data.provenance)
        if not series:
            return pushed
        return with_relaxed(pushed, followed(series, pushed, loads.times, None, 0.0).share)
    if loads.only(Pushed) is None:
        raise InputError(
            "the data holds other loads than `Pushed`, which the learners do not take: simulate pushes, or one tool's "
            "poses."
        )
    return only_pushed(loads)
