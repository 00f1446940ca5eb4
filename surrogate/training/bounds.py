"""Errors of a model relative to FEM, and bounds calibrated on loads that were not used to fit the model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim.bodies.tip_distance import build_tip_gauge
from sim.errors import InputError
from sim.loads import Loads, Pushed, select_cases

from ..data.cortex_patch import Patch
from ..data.dataset import Dataset
from ..data.indentation import add_relaxation, to_indentation
from ..data.load_histories import read_prony_series
from ..data.splits import DiscSplit
from ..evaluation.coverage import Coverage, measure_coverage
from ..evaluation.score import compute_force_errors, compute_point_errors
from ..model.conformal import Bound, BoundSettings, compute_scale_features, fit_bound, fit_growth
from ..model.learned import Learned, get_only_pushes
from ..model.relaxation import update_relaxation
from ..model.tip_distance import MAX_CONDITIONING_LOADS, TipModel, fit_correction
from ..model.training_range import Excess, LoadMeasures, measure_loads
from .examples import Examples
from .expansion import Expansion

SCALE_STRIDE = 3  # One in this many calibration loads fits a bound's scale; the others give its quantiles.
MIN_SCALE_LOADS = BoundSettings.loads_per_class  # Number of calibration loads below which all give the quantiles.


@dataclass(frozen=True, eq=False)
class ReferenceDistances:
    """Loads, and the distances (B,) [m] from tip to tumour under these loads, computed by FEM."""

    loads: Loads
    distance: np.ndarray

    def select(self, index: np.ndarray | slice) -> ReferenceDistances:
        """Select load cases by indices, a slice, or a mask (B,)."""
        return ReferenceDistances(self.loads.select(index), self.distance[index])


def compute_distance_errors(model: Learned, reference: ReferenceDistances) -> np.ndarray:
    """Compute the absolute errors (B,) [m] of a model's tip-tumour distances relative to FEM."""
    return np.abs(model.predict_distance(reference.loads).distance - reference.distance)


def add_distance_correction(model: Learned, patch: Patch, reference: ReferenceDistances) -> Learned:
    """Return the model with a distance correction, fitted to at most `MAX_CONDITIONING_LOADS` of its training loads."""
    plain, stride = replace(model, tip=TipModel()), -(-len(reference.loads) // MAX_CONDITIONING_LOADS)
    some = reference.select(slice(None, None, stride))
    off = some.distance - plain.predict_distance(some.loads).distance
    return replace(model, tip=TipModel(fit_correction(patch, model.to_input(some.loads), off)))


def improve_distances(
    model: Learned, patch: Patch, training: ReferenceDistances, held_out: ReferenceDistances
) -> tuple[Learned, np.ndarray]:
    """Add a distance correction if it reduces the mean held-out error; return the model and those errors (B,) [m]."""
    candidates = [replace(model, tip=TipModel()), add_distance_correction(model, patch, training)]
    error = [compute_distance_errors(each, held_out) for each in candidates]
    best = int(error[1].mean() < error[0].mean())
    return candidates[best], error[best]


TUMOUR_FIT = BoundSettings()  # Settings of the bound of the tumour.
# Settings of the bound of the tip distance. The cortex under the tip sometimes snaps through, so that the tail of the
# errors grows with force: classes are as small as a 99 % bound allows, and the scale's logarithm is linear.
TIP_FIT = BoundSettings(loads_per_class=100, allow_quadratic=False)
FORCE_FIT = BoundSettings()  # Settings of the bound of the force of a tool moved by pose.
BOUND_FITS = {"tumour": TUMOUR_FIT, "tip": TIP_FIT, "force": FORCE_FIT}  # Settings of all bounds, by name.


@dataclass(frozen=True, eq=False)
class BoundExamples:
    """Errors of a model on loads that were not used to fit the model.

    Parameters
    ----------
    pushes, measures, excess
        B loads, their measures, and their excess over the model's training range.
    features
        Features (B, f) on which the scale of bounds depends.
    error
        Errors (B,): of the distance or the maximum over the tumour's vertices [m], or of the tool's force [N].
    """

    pushes: Pushed
    measures: LoadMeasures
    excess: Excess
    features: np.ndarray
    error: np.ndarray

    def select(self, index: np.ndarray) -> BoundExamples:
        """Select loads by indices or by a mask (B,)."""
        known, outside = (
            LoadMeasures(*(each[index] for each in self.measures)),
            Excess(*(each[index] for each in self.excess)),
        )
        return BoundExamples(select_cases(self.pushes, index), known, outside, self.features[index], self.error[index])

    @property
    def extrapolated(self) -> np.ndarray:
        """Mask (B,) of loads outside the training range."""
        return self.excess.excess > 0.0

    @property
    def force(self) -> np.ndarray:
        """Force magnitudes (B,) [N], or depths [m] for poses."""
        return self.measures.magnitude


def collect_bound_examples(model: Learned, patch: Patch, pushes: Pushed, error: np.ndarray) -> BoundExamples:
    """Combine a model's errors (B,) on loads with the measures and features that bounds depend on."""
    known, envelope = measure_loads(patch, pushes), model.envelope
    features = compute_scale_features(pushes, envelope.clip_to_range(known))
    return BoundExamples(pushes, known, envelope.compute_excess(pushes, known), features, error)


def calibrate_bound(
    near_loads: BoundExamples, settings: BoundSettings, growth: float, examples: BoundExamples | None = None
) -> Bound:
    """Calibrate a bound on loads near the training loads; it grows by `growth` [1/m] with the distance from them.

    One in `SCALE_STRIDE` of these loads fits the bound's scale. The others, to whose distribution the guarantee
    applies, give its quantiles. With fewer than `MIN_SCALE_LOADS` loads and given `examples`, all loads give the
    quantiles, and `examples` fit the scale.
    """
    if examples is None or len(near_loads.error) >= MIN_SCALE_LOADS:
        fits = _mask_scale_loads(near_loads)
        examples, near_loads = near_loads.select(fits), near_loads.select(~fits)
    known = near_loads.features, near_loads.force, near_loads.error
    return fit_bound(
        (examples.features, examples.error), *known, settings, distance=near_loads.excess.distance, growth=growth
    )


def compute_growth(near_loads: BoundExamples, far_loads: BoundExamples, settings: BoundSettings) -> float:
    """Compute the growth [1/m] with which a bound has equal coverage far from and near training loads."""
    return fit_growth(*_compute_relative_errors(near_loads, far_loads, settings))


def compute_held_out_bounds(
    model: Learned, near_loads: BoundExamples, far_loads: BoundExamples, split: DiscSplit, settings: BoundSettings
) -> np.ndarray:
    """Compute bounds (2, B) [m] of loads on held-out discs; the other discs determine the growth for each disc."""
    known, (ratio, away) = _compute_relative_errors(near_loads, far_loads, settings)
    disc, bound = split.disc_index[split.test_mask], np.empty((2, len(far_loads.error)))
    for each in np.unique(disc):
        here = disc == each
        own = calibrate_bound(near_loads, settings, fit_growth(known, (ratio[~here], away[~here])))
        some = far_loads.select(here)
        bound[:, here] = model.compute_bounds(own, some.pushes, some.measures, some.excess)
    return bound


def measure_bound_coverage(bounds: np.ndarray, examples: BoundExamples) -> Coverage:
    """Compute the empirical coverage of the examples' errors by bounds (2, B) of the same unit."""
    return measure_coverage(examples.force, examples.error, bounds, int(examples.extrapolated.sum()))


def _compute_relative_errors(
    near_loads: BoundExamples, far_loads: BoundExamples, settings: BoundSettings
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return errors over a bound without growth, and distances [m] from training loads: near and far."""
    plain = calibrate_bound(near_loads, settings, 0.0)
    return [
        (each.error / plain.evaluate(each.features, each.force, each.excess.zero)[0], each.excess.distance)
        for each in (near_loads.select(~_mask_scale_loads(near_loads)), far_loads)
    ]


def _mask_scale_loads(near_loads: BoundExamples) -> np.ndarray:
    """Return the mask (B,) of the loads that fit a bound's scale."""
    return np.arange(len(near_loads.error)) % SCALE_STRIDE == 0


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """Errors of a model on B loads: maximum over the tumour's vertices, tip-tumour distance, and tool force.

    `tool_force` is the error of the force of a tool moved by pose; None if not available.
    """

    tumour_motion: BoundExamples
    tip_distance: BoundExamples
    tool_force: BoundExamples | None = None

    def list_available(self) -> dict[str, BoundExamples]:
        """Return the available errors by name, with the keys of `BOUND_FITS`."""
        found = {"tumour": self.tumour_motion, "tip": self.tip_distance}
        return found if self.tool_force is None else {**found, "force": self.tool_force}


@dataclass(frozen=True, eq=False)
class TrainingSolutions:
    """FEM results for the B converged load cases of a data set.

    Parameters
    ----------
    loads, pushes
        Loads as in the data set, and converted to a model's input.
    patch, nodes
        Open cortex, and mesh vertices (n,) of the tumour.
    tumour, cortex
        Displacements of the tumour (B, n, 3) and of the remaining open cortex (B, c, 3) [m].
    distances
        Distances from tip to tumour.
    force
        Force (B, 3) [N] of a tool moved by pose; None if not available.
    """

    loads: Loads
    pushes: Pushed
    patch: Patch
    nodes: np.ndarray
    tumour: np.ndarray
    cortex: np.ndarray
    distances: ReferenceDistances
    force: np.ndarray | None

    def select_examples(self, rows: np.ndarray) -> Examples:
        """Select rows by a mask (B,), as examples to fit models to."""
        force = None if self.force is None else self.force[rows]
        return Examples(select_cases(self.pushes, rows), self.tumour[rows], self.cortex[rows], force)

    def compute_vertex_errors(self, model: Learned, rows: np.ndarray) -> np.ndarray:
        """Compute a model's errors (k, n) [m] at the tumour's vertices, for the rows of a mask (B,)."""
        return compute_point_errors(model, self.loads.select(np.flatnonzero(rows)), self.tumour[rows], self.nodes)

    def compute_errors(
        self, model: Learned, rows: np.ndarray, tumour: np.ndarray | None = None, tip: np.ndarray | None = None
    ) -> ModelErrors:
        """Compute a model's errors on the rows of a mask (B,); `tumour` and `tip` (k,) [m] are used if given."""
        asked = select_cases(self.pushes, rows)

        def collect(error: np.ndarray) -> BoundExamples:
            return collect_bound_examples(model, self.patch, asked, error)

        return ModelErrors(
            collect(self.compute_vertex_errors(model, rows).max(axis=1) if tumour is None else tumour),
            collect(compute_distance_errors(model, self.distances.select(rows)) if tip is None else tip),
            None if self.force is None else collect(compute_force_errors(model.predict_force(asked), self.force[rows])),
        )


def read_solutions(data: Dataset, expansion: Expansion) -> TrainingSolutions:
    """Read the FEM results for the converged loads of a data set.

    Raises
    ------
    InputError
        Unit responses did not converge, the anatomy has no tumour, or the loads are neither `Pushed` nor `Touching` of
        one tool.
    """
    if not data.unit_good.all():
        raise InputError(
            f"{data.path}: {int((~data.unit_good).sum())} unit responses did not converge, so there is no compliance "
            "table: simulate again with a looser --tolerance."
        )
    loads = data.loads.select(np.flatnonzero(data.good))
    pushed, nodes = _convert_loads(data, loads, expansion.patch), expansion.tumour
    if not len(nodes):
        raise InputError(f"{data.path}: its anatomy has no tumour to predict: make one that has.")
    tumour = data.read_displacement(nodes)[data.good]
    cortex = data.read_displacement(expansion.cortex)[data.good]
    at, both = np.concatenate([nodes, expansion.cortex]), np.concatenate([tumour, cortex], axis=1)
    distances = ReferenceDistances(loads, build_tip_gauge(data.anatomy).compute_distances(loads, both, at, data.tool))
    reaction = None if data.tool is None else data.read_reaction()
    force = None if reaction is None else reaction[data.good, 0, :3]
    return TrainingSolutions(loads, pushed, expansion.patch, nodes, tumour, cortex, distances, force)


def _convert_loads(data: Dataset, loads: Loads, patch: Patch) -> Pushed:
    """Convert a data set's loads to a model's input, as `Learned.to_input` does."""
    if data.tool is not None:
        pushed, series = to_indentation(loads, data.tool, patch), read_prony_series(data.provenance)
        if not series:
            return pushed
        return add_relaxation(pushed, update_relaxation(series, pushed, loads.times, None, 0.0).relaxed_share)
    if loads.get_only(Pushed) is None:
        raise InputError(
            "the data holds other loads than `Pushed`, which the learners do not take: simulate pushes, or one tool's "
            "poses."
        )
    return get_only_pushes(loads)
