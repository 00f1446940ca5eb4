"""Training of models from a data set, with their scores on held-out discs and their bounds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from sim.errors import InputError
from sim.runtime.timing import time_stage

from ..data.cortex_patch import Patch
from ..data.dataset import Dataset
from ..data.splits import CALIBRATION_STRIDE, MAX_CALIBRATION_LOADS, DiscSplit, hold_out_discs
from ..evaluation.coverage import FORCE_CLASSES, Coverage
from ..evaluation.score import ForceScore, Score, score, score_forces
from ..model.conformal import LEVELS, USUAL_GROWTH, compute_conformal_quantile
from ..model.held_out import measure_held_out
from ..model.learned import Learned, ModelPart
from ..model.own_learners import OWN_LEARNERS, find_own_learner
from ..model.tip_distance import TipModel
from ..model.tool_contact import ForceModel
from ..model.training_range import TrainingRange, compute_training_range
from .bounds import (
    BOUND_FITS,
    ModelErrors,
    TrainingSolutions,
    add_distance_correction,
    calibrate_bound,
    compute_growth,
    compute_held_out_bounds,
    improve_distances,
    measure_bound_coverage,
    read_solutions,
)
from .examples import Examples
from .expansion import CONTACT_MODELS, SERIES_MODELS, Expansion
from .learners import LEARNED_MODELS, POSE_MODELS, SharedInputs, fit_force_model, fit_parts

LEARNERS = ("linear", *LEARNED_MODELS, *SERIES_MODELS)  # Model types for pushes.
POSE_LEARNERS = (*CONTACT_MODELS, *POSE_MODELS)  # Model types for poses.
MIN_CALIBRATION_LOADS = 19  # Minimum number of calibration loads for a 95 % bound.


@dataclass(frozen=True, eq=False)
class Trained:
    """Trained models by model type, their scores on held-out discs, and the split.

    `motion` is the mean displacement [m] of the tumour over the held-out loads. `calibrated` is the number of
    calibration loads, `training_loads` that of training loads. `held_out_coverage` gives, by model type, the empirical
    coverage of bounds on the held-out discs. These bounds belong to the scored model and are calibrated on loads
    outside the discs; their growth with distance is estimated from the other discs. `held_out_distance_coverage` gives
    the same for the tip-tumour distance. `force` gives the errors of the tool's force on the discs, for poses with
    known reactions.
    """

    models: dict[str, Learned]
    scores: tuple[Score, ...]
    split: DiscSplit
    motion: float
    calibrated: int
    training_loads: int
    held_out_coverage: dict[str, Coverage]
    held_out_distance_coverage: dict[str, Coverage]
    force: dict[str, ForceScore]

    # Former names, for one release.
    left_out = property(attrgetter("held_out_coverage"))
    distance_left_out = property(attrgetter("held_out_distance_coverage"))


def list_learners(data: Dataset) -> tuple[str, ...]:
    """Return the model types that a data set can train; series and contact types need data that give their tissue."""
    stated = "tissue" in data.provenance
    kinds = LEARNERS if data.tool is None else POSE_LEARNERS
    return tuple(name for name in kinds if stated or name not in (*SERIES_MODELS, *CONTACT_MODELS))


def check_learner_names(names: Sequence[str], has_poses: bool, source: str) -> None:
    """Check that data of poses, or of pushes, can train the model types; `source` names the data in the message.

    Raises
    ------
    InputError
        No name is given, a name is unknown, or a model type is for the other kind of data.
    """
    kinds, others, held = (POSE_LEARNERS, LEARNERS, "poses") if has_poses else (LEARNERS, POSE_LEARNERS, "pushes")
    unknown = [name for name in names if name not in (*kinds, *others) and find_own_learner(name) is None]
    if unknown or not names:
        allowed = ", ".join((*kinds, *OWN_LEARNERS))
        raise InputError(
            f"no learner is called {', '.join(unknown) or 'nothing'}: choose from {allowed}; "
            "a file with one of your own is named by --plugin."
        )
    strange = [name for name in names if name in others and name not in kinds]
    if strange:
        raise InputError(
            f"{source}: holds {held}, of which {', '.join(strange)} cannot be had: choose from {', '.join(kinds)}."
        )


def train(
    data: Dataset, learners: Sequence[str] | None = None, progress: Callable[[str], object] = lambda learner: None,
    split: DiscSplit | None = None, most: int | None = None, expansion: Expansion | None = None,
) -> Trained:  # fmt: skip
    """Fit models of the types `learners` (None: all that the data can train): first to score, then to use.

    Scored models are trained on loads outside discs of the cortex and scored on loads inside. Returned models are
    trained on both; their bounds are calibrated on further loads, which no fit uses. With a given `split`, which has a
    row for each converged load, nothing is calibrated, and the models trained on that split are returned.

    Every model predicts the tumour and the open cortex. The cortex is not scored; for pushes its response is that of
    the compliance matrix if the model type is not in `SERIES_MODELS`. Load cases that did not converge are ignored.

    Parameters
    ----------
    progress
        Receives the name of each model type that is finished.
    most
        Maximum number of training loads, without those for calibration or test; None: no limit.
    expansion
        Expansion of this data set; None: a new one on an available device. It takes minutes on a CPU, so pass it on to
        further trainings on the same data.

    Raises
    ------
    InputError
        A model type is unknown or for another kind of loads, or there are no training loads; the data have other causes
        than `Pushed` or `Touching` of one tool, no tumour, too few loads, or unit responses that did not converge.
    """
    wanted = list_learners(data) if learners is None else tuple(dict.fromkeys(learners))
    check_learner_names(wanted, has_poses=data.tool is not None, source=str(data.path))
    if most is not None and most < 1:
        raise InputError(f"{most} loads train nothing: give at least 1.")
    with time_stage("read"):
        shared = expansion or Expansion(data)
        answers = read_solutions(data, shared)
    apart = np.zeros(len(answers.loads), bool)
    if split is None:
        apart[len(apart) - min(len(apart) // CALIBRATION_STRIDE, MAX_CALIBRATION_LOADS) :] = True
        split = _extend_split(hold_out_discs(answers.pushes.point[~apart], answers.patch), apart)
    chosen = [_limit_rows(split.training_mask, most), *([_limit_rows(~apart, most)] if apart.any() else [])]
    fits = [_build_fit(answers, rows, shared, left) for rows, left in zip(chosen, (split, None), strict=False)]
    results = {}
    for name in wanted:
        results[name] = _train_and_score(name, data, answers, split, apart, fits)
        progress(name)
    return Trained(
        models={name: each.model for name, each in results.items()},
        scores=tuple(each.score for each in results.values()),
        split=split,
        motion=float(_compute_motion(answers, split.test_mask).mean()),
        calibrated=int(apart.sum()),
        training_loads=int(fits[-1].rows.sum()),
        held_out_coverage={name: each.coverage for name, each in results.items() if each.coverage},
        held_out_distance_coverage={
            name: each.distance_coverage for name, each in results.items() if each.distance_coverage
        },
        force={name: each.force for name, each in results.items() if each.force},
    )


@dataclass(frozen=True, eq=False)
class ModelFit:
    """Inputs of a fit: mask (B,) of training rows, their examples, inputs shared by model types, and training range."""

    rows: np.ndarray
    examples: Examples
    inputs: SharedInputs
    envelope: TrainingRange

    def fit_parts(self, name: str, patch: Patch) -> tuple[tuple[ModelPart, ...], ForceModel | None]:
        """Fit a model type; return the parts of its model, and its model of the tool's force, if any."""
        with time_stage(f"learn {name}"):
            parts = fit_parts(name, self.inputs, self.examples)
            return parts, fit_force_model(name, parts, patch, self.examples)


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """Model of one type, with its score on held-out discs and the empirical coverage of its bounds there."""

    model: Learned
    score: Score
    coverage: Coverage | None
    distance_coverage: Coverage | None
    force: ForceScore | None


def _build_fit(results: TrainingSolutions, rows: np.ndarray, expansion: Expansion, split: DiscSplit | None) -> ModelFit:
    examples = results.select_examples(rows)
    return ModelFit(
        rows, examples, SharedInputs(examples, expansion, split), compute_training_range(results.patch, examples.loads)
    )


def _train_and_score(
    name: str, data: Dataset, results: TrainingSolutions, split: DiscSplit, spare: np.ndarray, fits: Sequence[ModelFit]
) -> TrainingResult:
    """Fit a model type outside the discs and score it inside; then fit it to all loads that are not for calibration."""
    outside, patch = fits[0], results.patch
    parts, force = outside.fit_parts(name, patch)
    training = {"learner": name, **data.provenance}
    model = Learned(data.anatomy, parts, outside.envelope, training=training, tool=data.tool, force=force)
    with time_stage("score"):
        test = results.loads.select(np.flatnonzero(split.test_mask))
        solves = outside.inputs.count_solves(name, outside.examples)
        scored = score(name, model, test, results.tumour[split.test_mask], results.nodes, solves)
        distance = results.compute_vertex_errors(model, split.test_mask)
        trained, held_out = (results.distances.select(rows) for rows in (outside.rows, split.test_mask))
        model, off = improve_distances(model, patch, trained, held_out)
        far = results.compute_errors(model, split.test_mask, distance.max(axis=1), off)
        error = far.tumour_motion.error
        model = replace(model, bound=min(compute_conformal_quantile(error, LEVELS[0]), float(error.max())))
    growth = dict.fromkeys(BOUND_FITS, USUAL_GROWTH)
    of_tumour = of_tip = None
    promised, beside = None, spare & ~split.is_covered(results.pushes.point)
    if beside.sum() >= 2 * MIN_CALIBRATION_LOADS and len(test) >= FORCE_CLASSES:
        with time_stage("calibrate"):
            near, there = results.compute_errors(model, beside).list_available(), far.list_available()
            growth = {way: compute_growth(near[way], there[way], BOUND_FITS[way]) for way in near}
            bound = {way: compute_held_out_bounds(model, near[way], there[way], split, BOUND_FITS[way]) for way in near}
            of_tumour, of_tip = (
                measure_bound_coverage(bound["tumour"], far.tumour_motion),
                measure_bound_coverage(bound["tip"], far.tip_distance),
            )
            motion = _compute_motion(results, split.test_mask)
            model = replace(
                model, held_out=measure_held_out(distance, motion, bound["tumour"][0], far.tumour_motion.extrapolated)
            )
            promised = bound.get("force")
    forces = None
    if far.tool_force is not None and results.force is not None:
        forces = score_forces(far.tool_force.error, results.force[split.test_mask], promised)
    if spare.any():
        model = _fit_on_all(name, model, results, fits[1])
    if spare.sum() >= MIN_CALIBRATION_LOADS:
        with time_stage("calibrate"):
            model = _add_bounds(model, results.compute_errors(model, spare), growth, far)
    return TrainingResult(model, scored, of_tumour, of_tip, forces)


def _fit_on_all(name: str, model: Learned, solutions: TrainingSolutions, fit: ModelFit) -> Learned:
    """Fit the model type to the rows of `fit`; add a distance correction if `model` has one."""
    parts, force = fit.fit_parts(name, solutions.patch)
    fitted = replace(model, parts=parts, envelope=fit.envelope, force=force)
    if model.tip is None or model.tip.correction is None:
        return fitted
    with time_stage(f"learn {name}"):
        return add_distance_correction(fitted, solutions.patch, solutions.distances.select(fit.rows))


def _add_bounds(
    model: Learned, interpolation: ModelErrors, growth: Mapping[str, float], extrapolation: ModelErrors
) -> Learned:
    """Return the model with bounds calibrated on errors near training loads; each grows by its `growth` [1/m]."""
    seen = extrapolation.list_available()
    bounds = {
        way: calibrate_bound(here, BOUND_FITS[way], growth[way], seen[way])
        for way, here in interpolation.list_available().items()
    }
    tip, force = model.tip or TipModel(), model.force
    return replace(
        model,
        bounds=bounds["tumour"],
        tip=replace(tip, bound=bounds["tip"]),
        force=force and replace(force, bound=bounds["force"]),
    )


def _compute_motion(solutions: TrainingSolutions, rows: np.ndarray) -> np.ndarray:
    """Compute the tumour's mean displacement [m] for each selected row of a mask (B,)."""
    return np.linalg.norm(solutions.tumour[rows], axis=2).mean(axis=1)


def _limit_rows(rows: np.ndarray, max_rows: int | None) -> np.ndarray:
    """Keep the first `max_rows` rows of a mask (B,); None: keep all."""
    return rows if max_rows is None else rows & (np.cumsum(rows) <= max_rows)


def _extend_split(split: DiscSplit, spare: np.ndarray) -> DiscSplit:
    """Extend a split to all rows (B,); the rows `spare` get the disc index -2."""
    disc = np.full(len(spare), -2)
    disc[~spare] = split.disc_index
    return replace(split, disc_index=disc)
