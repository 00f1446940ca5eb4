"""Trained deformer: it predicts the displacements of the tumour and of the open cortex."""

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, reduce
from operator import add, attrgetter

import numpy as np

from sim.anatomy import Anatomy
from sim.arguments import check_integers
from sim.bodies.tip_distance import build_tip_gauge
from sim.deformation import Cost, Deformation, Outcome
from sim.errors import InputError
from sim.loads import Loads, Pushed, check_loads
from sim.material import Pairs
from sim.runtime.threads import limit_to_one_thread
from sim.tools import BuiltIn

from ..data.cortex_patch import Patch, find_nearest, open_patch
from ..data.encode import ENCODERS, Basis, Encoder, split_forces
from ..data.indentation import add_relaxation, get_only_pushes, get_poses, to_indentation
from ..data.load_histories import read_prony_series
from ..data.solution_rows import read_tissue_text
from ..regressors.protocol import FittedRegressor
from ..regressors.rigid_contact import RigidContact
from .conformal import LEVELS, Bound, compute_scale_features
from .held_out import HeldOutErrors
from .relaxation import MEMORY_KEY, RelaxationState, update_relaxation
from .tip_distance import TipModel, TumourDistance
from .tool_contact import ForceModel, build_warm_encoders, collect_contact_state, compute_wrench
from .training_range import Excess, LoadMeasures, TrainingRange, measure_loads

# Largest force or footprint, relative to the training's largest. On the template FEM has no equilibrium for 3 loads of
# this size, and at twice the force the error of a prediction is up to 31 %.
MAX_TRAINING_RATIO = 3.0
STORED_TOLERANCE = 1e-6  # Rounding error of training points, stored in single precision [m].


@dataclass(frozen=True, eq=False)
class ModelPart:
    """One summand of the predicted response, at the basis's vertices: encoder, regressor and basis.

    Parameters
    ----------
    encoder
        Name in `ENCODERS`.
    regressor
        Map from features to basis coefficients, fitted to responses to a force of one newton.
    basis
        Map from coefficients to responses.
    """

    encoder: str
    regressor: FittedRegressor
    basis: Basis

    def compute_response(self, features: np.ndarray) -> np.ndarray:
        """Compute the responses (B, n, 3) [m/N] of `basis.nodes`, from the encoder's features (B, f)."""
        return self.basis.decode(self.regressor.predict(features))


@dataclass(frozen=True, eq=False)
class Learned:
    """Trained `Deformer`: a sum of parts.

    Every part predicts the response per newton, which is multiplied by the force, so zero force gives zero motion.

    Parameters
    ----------
    anatomy
        Anatomy of the training.
    parts
        Parts; their predictions are summed at vertices that they share.
    envelope
        Range of the training loads.
    bound
        95th percentile of the maximum vertex error of the tumour on held-out loads, relative to FEM [m].
    bounds
        Conformal bound of each load's error; None if no calibration loads were set aside.
    training
        Training settings and provenance of the training data, as text.
    tool
        Tool whose poses the model supports, with depth [m] instead of force; None if the model supports pushes.
    tip
        Correction and bound of the distance from tip to tumour; None if not trained.
    held_out
        Errors on held-out cortex; None if none was held out, or for older files.
    force
        Model of the tool's force; None if not trained.

    Examples
    --------
    >>> from scenes import open_theatre
    >>> from sim import open_cortex, push
    >>> model = open_theatre(device="cpu").models["series-gp"]
    >>> place = open_cortex(model.anatomy).place()
    >>> result = model.deform(push(place.point, 0.3 * place.inward, footprint=7e-3), at=model.anatomy.tumour_nodes)
    >>> print(f"{1e3 * np.linalg.norm(result.displacement[0].mean(axis=0)):.1f} mm; {result.outcome[0].value}")
    1.2 mm; predicted by a trained model inside its training range
    """

    anatomy: Anatomy
    parts: tuple[ModelPart, ...]
    envelope: TrainingRange
    bound: float = float("nan")
    bounds: Bound | None = None
    training: Mapping[str, str] = field(default_factory=dict)
    tool: BuiltIn | None = None
    tip: TipModel | None = None
    held_out: HeldOutErrors | None = None
    force: ForceModel | None = None

    @cached_property
    def source(self) -> str:
        """Description of the model type and its training, for `Deformation.source`."""
        stated = self.training
        tissue = str(read_tissue_text(stated)) if "tissue" in stated else "tissue not given"
        element = stated.get("element", "not given")
        return f"{stated.get('learner', 'learned')}, trained on FEM ({element}; {tissue})"

    @cached_property
    def series(self) -> Pairs:
        """Prony series of the tissue if the model includes relaxation over time; else ()."""
        return () if self.tool is None else read_prony_series(self.training)

    @cached_property
    def nodes(self) -> np.ndarray:
        """Sorted mesh vertices (n,) that the model predicts."""
        return np.unique(np.concatenate([part.basis.nodes for part in self.parts]))

    @cached_property
    def _regressors(self) -> list[FittedRegressor]:
        return [part.regressor for part in self.parts]

    @cached_property
    def _patch(self) -> Patch:
        return open_patch(self.anatomy)

    @cached_property
    def _restrict_modes(self) -> Callable[[bytes], tuple[tuple[list[ModelPart], np.ndarray], ...]]:
        """Function from vertices (int64 bytes) to the parts of each basis, with its modes (r, 3 n) at the vertices."""
        groups: dict[int, list[ModelPart]] = {}
        for part in self.parts:
            groups.setdefault(id(part.basis.modes), []).append(part)

        def restrict_modes(nodes: bytes) -> tuple[tuple[list[ModelPart], np.ndarray], ...]:
            asked, found = np.frombuffer(nodes, np.int64), []
            for parts in groups.values():
                basis = parts[0].basis
                here, row = np.nonzero(asked[:, None] == basis.nodes)
                modes = np.zeros((len(basis.modes), len(asked), 3), np.float32)
                modes[:, here] = basis.modes.reshape(len(modes), -1, 3)[:, row]
                if len(here):
                    found.append((parts, modes.reshape(len(modes), -1)))
            return tuple(found)

        return lru_cache(maxsize=4)(restrict_modes)

    @cached_property
    def _is_predicted(self) -> np.ndarray:
        """Mask (V,) of the mesh vertices that the model predicts."""
        known = np.zeros(len(self.anatomy.mesh.nodes), bool)
        known[self.nodes] = True
        return known

    def _check_in_range(self, pushes: Pushed, uncertain_rows: np.ndarray) -> None:
        """Raise InputError for loads outside the open cortex, or far beyond the training range.

        Only `uncertain_rows` (k,) can fail the contact test: a load inside the training range touches the cortex,
        unless its radius is too small.
        """
        if not len(uncertain_rows):
            return
        force = ("a force", 1.0, "N") if self.tool is None else ("a depth", 1e3, "mm")
        for (name, unit, symbol), size, (_, most) in (
            (force, split_forces(pushes)[0], self.envelope.force),
            (("a footprint", 1e3, "mm"), pushes.footprint, self.envelope.footprint),
        ):
            far = np.flatnonzero(size > MAX_TRAINING_RATIO * most)
            if len(far):
                raise InputError(
                    f"load {far[0]} has {name} of {unit * size[far[0]]:.3g} {symbol}, but this model was trained on "
                    f"{unit * most:.3g} {symbol} at most: give up to {MAX_TRAINING_RATIO:g} times that, or ask the "
                    "finite elements."
                )
        away = find_nearest(pushes.point[uncertain_rows], self._patch.points)[1]
        if (away > pushes.footprint[uncertain_rows]).any():  # away from nodes, but perhaps not from triangles
            self._patch.contact_surface.check_contact(pushes.point, pushes.footprint)

    def _check_nodes(self, nodes: np.ndarray) -> None:
        inside = (nodes >= 0) & (nodes < len(self._is_predicted))
        strange = ~(inside & self._is_predicted[np.where(inside, nodes, 0)])
        if strange.any():
            raise InputError(
                f"this model knows the {len(self.nodes)} vertices of tumour and open cortex, not vertex "
                f"{nodes[strange][0]}: ask the finite elements for it."
            )

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Predict the static deformation under `Pushed` loads, or under poses of the model's tool.

        The contact search of a rod or a blade starts from the contact in `start`, which is faster; without `start` the
        tool approaches straight. Relaxing tissue continues from `start`; without it, see `data.load_histories`.

        Raises
        ------
        InputError
            Loads are of another kind, do not touch the open cortex, or have more than `MAX_TRAINING_RATIO` times the
            training's largest force or footprint; `start` has another number of load cases or another state, see
            `update_relaxation`; a vertex in `at` is not predicted.
        """
        check_loads(loads)
        if start is not None and not isinstance(start, Deformation):
            raise InputError(f"the start is a {type(start).__name__}: give a Deformation, or none.")
        if start is not None and len(start) != len(loads):
            raise InputError(
                f"the start has displacements of shape {start.displacement.shape}: give one row for each of the "
                f"{len(loads)} load cases."
            )
        begun = time.perf_counter()
        pushed, past = self._convert_loads(loads, start)
        nodes = self.nodes if at is None else check_integers("at", at)
        self._check_nodes(nodes)
        with limit_to_one_thread() if len(loads) == 1 else nullcontext():
            return self._sum_parts(loads, pushed, nodes, begun, past, build_warm_encoders(self._regressors, start))

    def _sum_parts(
        self, loads: Loads, pushes: Pushed, nodes: np.ndarray, start_time: float, relaxation: RelaxationState | None,
        encoders: Mapping[str, Encoder],
    ) -> Deformation:  # fmt: skip
        """Sum the predictions of the parts and build the result; the computation began at `start_time` [s]."""
        known = measure_loads(self._patch, pushes)
        outside = self.envelope.compute_excess(pushes, known)
        far, small = outside.excess > 0.0, pushes.footprint < self.envelope.reach + STORED_TOLERANCE
        self._check_in_range(pushes, np.flatnonzero(far | small))
        promised = self.compute_bounds(self.bounds, pushes, known, outside)
        if relaxation is not None:
            far = far | relaxation.outside_training
        motion = self.predict_motion(pushes, nodes, encoders)
        answer = build_prediction(motion, nodes, loads, far, start_time, promised, self.source)
        if relaxation is not None:
            answer = replace(answer, memory={MEMORY_KEY: relaxation.memory})
        if self.tool is not None:
            answer = replace(
                answer,
                warm=collect_contact_state(self._regressors, self._patch, self.clip_to_range(pushes)[1], encoders),
            )
        if self.force is None or self.tool is None:
            return answer
        return replace(
            answer,
            reaction=compute_wrench(self.predict_force(pushes, encoders), get_poses(loads, self.tool), self.tool),
            reaction_bound=self.compute_bounds(self.force.bound, pushes, known, outside),
            cost=Cost({"predict": time.perf_counter() - start_time}),
        )

    def predict_motion(
        self, pushes: Pushed, nodes: np.ndarray, encoders: Mapping[str, Encoder] = ENCODERS
    ) -> np.ndarray:
        """Predict displacements (B, n, 3) [m] of mesh vertices `nodes` (n,), without range checks and bound.

        Outside the range of training forces, the response per newton of the nearest training force is used.
        """
        magnitude, asked = self.clip_to_range(pushes)
        if not len(nodes):
            return np.zeros((len(magnitude), 0, 3))
        groups = self._restrict_modes(np.asarray(nodes, np.int64).tobytes())
        names = {part.encoder for parts, _ in groups for part in parts}
        features = {name: encoders[name](self._patch, asked) for name in sorted(names)}
        responses = [
            reduce(add, [part.regressor.predict(features[part.encoder]) for part in parts]) @ modes
            for parts, modes in groups
        ]
        return magnitude[:, None, None] * reduce(add, responses).reshape(-1, len(nodes), 3)

    def clip_to_range(self, pushes: Pushed) -> tuple[np.ndarray, Pushed]:
        """Return forces [N] or depths [m] (B,), and the loads with these clipped to the training range."""
        magnitude, direction = split_forces(pushes)
        return magnitude, replace(pushes, force=np.clip(magnitude, *self.envelope.force)[:, None] * direction)

    def predict_force(self, pushes: Pushed, encoders: Mapping[str, Encoder] = ENCODERS) -> np.ndarray:
        """Predict the tool's forces (B, 3) [N] at indentations, proportional to depth beyond the training's depths.

        Raises
        ------
        InputError
            The model was trained without the tool's force.
        """
        if self.force is None:
            raise InputError("this model does not know its tool's force: train it again, on newly simulated poses.")
        magnitude, asked = self.clip_to_range(pushes)
        found = np.zeros(pushes.force.shape) + self.force.predict_remainder(self._patch, asked)
        for part in self.parts:
            if isinstance(part.regressor, RigidContact):
                found += part.regressor.predict_force(encoders[part.encoder](self._patch, asked))
        return magnitude[:, None] * found

    def compute_bounds(self, bound: Bound | None, pushes: Pushed, measures: LoadMeasures, excess: Excess) -> np.ndarray:
        """Compute error bounds (2, B) of loads, in [m], or in [N] for a force; NaN if `bound` is None."""
        if bound is None:
            return np.stack([np.nan * excess.excess] * len(LEVELS))
        # The error, like the motion, is in proportion to a force below the training's smallest.
        weaker = np.minimum(measures.magnitude / self.envelope.force[0], 1.0)
        features = compute_scale_features(pushes, self.envelope.clip_to_range(measures))
        return np.where(weaker > 0.0, bound.evaluate(features, measures.magnitude, excess), 0.0) * weaker

    def predict_distance(
        self, loads: Loads, answer: Deformation | None = None, apart: np.ndarray | None = None
    ) -> TumourDistance:
        """Predict the distance from the tool's tip to the tumour in the deformed brain, as measured by `TipGauge`.

        Parameters
        ----------
        answer
            This model's result for the loads, at least at the open cortex and the tumour; None: it is computed.
        apart
            Distances (B,) [m] in `answer`, if already measured; None: they are measured.

        Raises
        ------
        InputError
            The loads are of another kind, or `answer` lacks vertices of the open cortex or the tumour.
        """
        # With the result of the same loads as start, no time passes.
        pushed = self._convert_loads(loads, answer)[0]
        if apart is None:
            if answer is None:
                answer = self.deform(loads, at=self.nodes)
            apart = build_tip_gauge(self.anatomy).compute_distances(loads, answer.displacement, answer.nodes, self.tool)
        tip = self.tip or TipModel()
        magnitude, within = self.clip_to_range(pushed)
        found = tip.apply_correction(apart, self._patch, within, magnitude)
        known = measure_loads(self._patch, pushed)
        return TumourDistance(
            found, self.compute_bounds(tip.bound, pushed, known, self.envelope.compute_excess(pushed, known))
        )

    def to_input(self, loads: Loads) -> Pushed:
        """Convert loads to the model's input: pushes, or indentations by its tool (`to_indentation`).

        Raises
        ------
        InputError
            The loads are of another kind.
        """
        return self._convert_loads(loads)[0]

    def _convert_loads(self, loads: Loads, start: Deformation | None = None) -> tuple[Pushed, RelaxationState | None]:
        """Convert loads as `to_input`; return them and the relaxation state after `start`, None without relaxation."""
        if self.tool is None:
            return get_only_pushes(loads), None
        pushed = to_indentation(loads, self.tool, self._patch)
        if not self.series:
            return pushed, None
        past = update_relaxation(self.series, pushed, loads.times, start, self.envelope.force[0])
        return add_relaxation(pushed, past.relaxed_share), past

    # Former names, for one release.
    motion, within, exerted, promised = predict_motion, clip_to_range, predict_force, compute_bounds
    distance, asked, left_out = predict_distance, to_input, property(attrgetter("held_out"))


def build_prediction(
    displacement: np.ndarray, nodes: np.ndarray, loads: Loads, outside_range: Iterable[bool], start_time: float,
    bound: np.ndarray, source: str,
) -> Deformation:  # fmt: skip
    """Build a model's result, computed since `start_time` [s]; loads of `outside_range` (B,) are marked extrapolated.

    `displacement` (B, n, 3) [m] belongs to the vertices `nodes` (n,); `bound` and `source` are as in `Deformation`.
    """
    count = len(loads)
    pushed, unknown = loads.get(Pushed), np.full(count, np.nan)
    reaction = np.zeros((count, 0 if pushed is None else 1, 6))  # for a pose, the caller adds it
    if pushed is not None:
        reaction[:, 0, :3] = pushed.force
    return Deformation(
        displacement,
        nodes,
        tuple([Outcome.EXTRAPOLATED if far else Outcome.PREDICTED for far in outside_range]),
        np.zeros(count, int),
        unknown,
        loads.times,
        reaction,
        cost=Cost({"predict": time.perf_counter() - start_time}),
        reached=unknown,
        inverted=np.full(count, -1),
        bound=bound,
        source=source,
    )
