"""Learners: the inputs of each model type, and the fit of the parts of its model to displacements."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sim.errors import InputError
from sim.loads import Pushed

from ..data.cortex_patch import Patch, find_nearest
from ..data.encode import ENCODERS, Basis, fit_basis, split_forces
from ..data.splits import DiscSplit
from ..data.tool_loads import pick_far_points
from ..evaluation.score import SolveCounts
from ..model.learned import ModelPart
from ..model.own_learners import find_learner_name, find_own_learner
from ..model.tool_contact import ForceModel
from ..regressors.baselines import Ann, Pcr, Svr
from ..regressors.force_series import TERM_COUNT, RemainderGp
from ..regressors.gp import Gp
from ..regressors.protocol import FittedRegressor, RegressorFactory
from ..regressors.rigid_contact import RigidContact
from .examples import Examples, compute_residual_responses
from .expansion import ADDED_BASIS, COARSE_BASIS, CONTACT_MODELS, SERIES_MODELS, Expansion
from .fem_tables import join_bases


@dataclass(frozen=True, eq=False)
class SharedInputs:
    """Inputs shared by all model types on a data set; each is computed on first use.

    Results and series within held-out discs are excluded. The response of linear tissue is included at every node, also
    within the discs: a dent is not a combination of dents elsewhere, and the motion below follows the dent. The
    tumour's second order is also included, as it follows from that response and the material law.

    Parameters
    ----------
    basis_examples
        Examples whose responses span the series' bases.
    expansion
        Expansion of the same data.
    split
        Split with the held-out loads; None: no load is held out.
    """

    basis_examples: Examples
    expansion: Expansion
    split: DiscSplit | None = None

    @cached_property
    def series(self) -> tuple[ModelPart, ...]:
        """Parts of the power series beyond the exact parts, for the tumour and for the cortex, if any."""
        bases = self.expansion.build_bases(self.basis_examples, ADDED_BASIS, COARSE_BASIS)
        found = self.expansion.build_series(bases, self._mask_held_out(self.expansion.positions))
        return tuple(ModelPart("tool", part, basis) for part, basis in zip(found, bases, strict=True))

    def count_solves(self, name: str, examples: Examples) -> SolveCounts:
        """Count the FEM solves that a model of type `name` depends on, with their wall time."""
        known, data, loads = self.expansion, self.expansion.data, len(examples.loads.point)
        units = series = inside = 0
        seconds = [data.estimate_seconds("load", loads)]
        of_tumour = name in ("linear", "residual", *SERIES_MODELS)
        if data.tool is None and (len(known.cortex) or of_tumour):
            units = len(data.unit_good)
            inside = 3 * of_tumour * int(self._mask_held_out(known.patch.points).sum())
            seconds.append(data.estimate_seconds("unit response", units))
        if name in CONTACT_MODELS:
            contact, _, took = known.contact
            units, inside = contact.points.size, 3 * int(self._mask_held_out(contact.points).sum())
            seconds.append(took)
        if name in SERIES_MODELS:
            places = int((~self._mask_held_out(known.positions)).sum())
            series = places * len(known.radii) * TERM_COUNT
            took = known.table.seconds * places / len(known.positions)
            seconds.append(took if np.isfinite(took) else None)
        total = None if None in seconds else float(sum(filter(None, seconds)))
        return SolveCounts(loads, units, series, inside, total)

    def _mask_held_out(self, points: np.ndarray) -> np.ndarray:
        return np.zeros(len(points), bool) if self.split is None else self.split.is_covered(points)


@dataclass(frozen=True)
class TuningSettings:
    """Settings of the selection of regressor settings by `TunedRegressor`."""

    inner_discs: int = 6  # Number of distant discs that inner fits hold out.
    inner_share: float = 0.2  # Share of the loads in the held-out discs of inner fits.
    min_selection_loads: int = 40  # Minimum number of loads for a selection of settings.
    max_selection_loads: int = 600  # Maximum number of loads used for a selection of settings.
    selection_outputs: int = 8  # Number of outputs, those of largest variance, used for a selection of settings.


@dataclass(frozen=True)
class TunedRegressor:
    """Regressor that selects its settings by the error on discs held out of the training rows.

    Each candidate is fitted to the strongest outputs of 4/5 of the first rows; the best one is then fitted to all rows.

    Parameters
    ----------
    settings
        Candidate regressors; the first is used if there are too few rows for a selection.
    selection
        Settings of the selection.
    """

    settings: tuple[Callable[[], RegressorFactory], ...]
    selection: TuningSettings = TuningSettings()

    def fit(self, X: np.ndarray, Y: np.ndarray) -> FittedRegressor:
        """Fit the best candidate to features X (n, f) of `compute_tool_features` and coefficients Y (n, r)."""
        return self.settings[self.find_best(X, Y)]().fit(X, Y)

    def find_best(self, X: np.ndarray, Y: np.ndarray) -> int:
        """Return the index of the candidate with the smallest squared error on the held-out discs."""
        if len(X) < self.selection.min_selection_loads or len(self.settings) == 1:
            return 0
        X, Y = X[: self.selection.max_selection_loads], Y[: self.selection.max_selection_loads]
        held_out = find_inner_discs(X[:, :3], self.selection)
        columns = np.sort(np.argsort(-Y.std(axis=0), kind="stable")[: self.selection.selection_outputs])
        strongest = Y[:, columns]
        errors = []
        for make in self.settings:
            model = make().fit(X[~held_out], strongest[~held_out])
            errors.append(float(np.square(model.predict(X[held_out]) - strongest[held_out]).sum()))
        return int(np.argmin(errors))


def find_inner_discs(points: np.ndarray, selection: TuningSettings = TuningSettings()) -> np.ndarray:
    """Return the mask (n,) of points (n, 3) in discs round `inner_discs` distant points, with `inner_share` of all."""
    distance = find_nearest(points, points[pick_far_points(points, selection.inner_discs)])[1]
    return distance <= np.quantile(distance, selection.inner_share)


# Candidate networks, the default first: units in a layer and weight decay.
ANN_CANDIDATES = tuple(partial(Ann, hidden, decay) for hidden in (64, 128) for decay in (1e-2, 3e-3))
# Candidate support vector regressions, the default first: C and epsilon [quartile ranges].
SVR_CANDIDATES = tuple(
    partial(Svr, c, tube) for c in (1.0 / 1.349, 10.0, 100.0) for tube in (1.0 / 13.49, 1e-2, 3e-3, 1e-3)
)
# Encoder and regressor of each model type but the compliance matrix; principal components are those of the nodal
# forces.
LEARNED_MODELS: dict[str, tuple[str, Callable[[], RegressorFactory]]] = {
    "pcr": ("nodal", Pcr),
    "ann": ("tool", partial(TunedRegressor, ANN_CANDIDATES)),
    "svr": ("tool", partial(TunedRegressor, SVR_CANDIDATES)),
    "gp": ("tool", Gp),
    "residual": ("tool", partial(TunedRegressor, ANN_CANDIDATES)),
}
POSE_MODELS = ("gp", "ann", "svr")  # Model types for poses: the tool's position replaces its force.


def fit_parts(name: str, inputs: SharedInputs, examples: Examples) -> tuple[ModelPart, ...]:
    """Fit the parts of one model type to examples: parts for the tumour, and for the remaining open cortex."""
    known = inputs.expansion
    trained = partial(_fit_part, known.patch, examples.loads)
    if name in SERIES_MODELS:
        added = inputs.series
        exact = [part for parts in known.exact_parts for part in parts]
        if name == "series":
            return (*exact, *added)
        both = zip(known.exact_parts, added, (examples.tumour, examples.cortex), strict=False)
        left = [trained(("tool", RemainderGp), (*parts, more), more.basis, truth) for parts, more, truth in both]
        return (*exact, *added, *left)
    if name == "linear":
        return known.compliance_parts
    if name in CONTACT_MODELS:
        contact, left = _fit_contact(known, examples)
        if name == "contact":
            return (contact,)
        return (contact, *(trained(LEARNED_MODELS["gp"], (), nodes, rest) for nodes, rest in left))
    if known.data.tool is not None:
        both = ((known.tumour, examples.tumour), (known.cortex, examples.cortex))
        return tuple(trained(_find_model_type(name), (), nodes, truth) for nodes, truth in both if len(nodes))
    tumour, *cortex = known.compliance_parts
    before = (tumour,) if name == "residual" else ()
    learnt = trained(_find_model_type(name), before, known.tumour, examples.tumour)
    return (*before, learnt, *cortex)


def fit_force_model(name: str, parts: Sequence[ModelPart], patch: Patch, examples: Examples) -> ForceModel | None:
    """Fit the force model of a pose model, given its fitted `parts`; None if the examples have no force."""
    if examples.force is None:
        return None
    if name == "contact":
        return ForceModel()
    encoder, make = LEARNED_MODELS["gp"] if name in CONTACT_MODELS else _find_model_type(name)
    X = ENCODERS[encoder](patch, examples.loads)
    left = examples.force / split_forces(examples.loads)[0][:, None]
    for part in parts:
        if isinstance(part.regressor, RigidContact):
            left = left - part.regressor.predict_force(ENCODERS[part.encoder](patch, examples.loads))
    learned = make().fit(X, left)
    if find_learner_name(type(learned)) is not None:
        _check_own_learner(learned, X, left)
    return ForceModel(encoder, learned)


def _find_model_type(name: str) -> tuple[str, Callable[[], RegressorFactory]]:
    """Return the encoder name and the regressor factory of a built-in or user-defined model type."""
    if name in LEARNED_MODELS:
        return LEARNED_MODELS[name]
    own = find_own_learner(name)
    assert own is not None, name  # checked by the caller
    return own.encoder, own.regressor


def _fit_contact(series: Expansion, examples: Examples) -> tuple[ModelPart, list[tuple[np.ndarray, np.ndarray]]]:
    """Fit the contact part to examples; return it, and the vertices and residuals (B, n, 3) [m] of each basis."""
    contact, bases, _ = series.contact
    encoder = "core" if len(contact.core) else "tool"
    features, size = ENCODERS[encoder](series.patch, examples.loads), split_forces(examples.loads)[0][:, None, None]
    truth = [examples.tumour, examples.cortex][: len(bases)]
    coefficients = np.hstack([basis.encode(each / size) for basis, each in zip(bases, truth, strict=True)])
    alike = np.repeat(np.arange(len(bases)), [len(basis.modes) for basis in bases])
    force = None if examples.force is None else examples.force / size[:, 0]
    part = ModelPart(encoder, contact.fit_lines(features, coefficients, alike, force), join_bases(bases))
    answered = np.split(size * part.compute_response(features), [len(series.tumour)], axis=1)
    return part, [(basis.nodes, one - other) for basis, one, other in zip(bases, truth, answered, strict=False)]


def _fit_part(
    patch: Patch, loads: Pushed, model_type: tuple[str, Callable[[], RegressorFactory]], previous: Sequence[ModelPart],
    support: Basis | np.ndarray, motion: np.ndarray,
) -> ModelPart:  # fmt: skip
    """Fit a part to the residual of `motion` (B, n, 3) [m] after `previous`; `support` is a basis or vertices."""
    response = compute_residual_responses(previous, patch, loads, motion)
    basis = support if isinstance(support, Basis) else fit_basis(support, response, *COARSE_BASIS)
    encoder, make = model_type
    X, Y = ENCODERS[encoder](patch, loads), basis.encode(response)
    regressor = make().fit(X, Y)
    if find_learner_name(type(regressor)) is not None:
        _check_own_learner(regressor, X, Y)
    return ModelPart(encoder, regressor, basis)


def _check_own_learner(regressor: FittedRegressor, X: np.ndarray, Y: np.ndarray) -> None:
    """Check that a user-defined regressor predicts finite coefficients of the right shape for its training loads."""
    found = np.asarray(regressor.predict(X))
    if found.shape != Y.shape or not np.isfinite(found).all():
        raise InputError(
            f"the learner {find_learner_name(type(regressor))} returns shape {found.shape} for {X.shape[0]} loads: "
            f"let `predict` give {Y.shape}, all finite."
        )
