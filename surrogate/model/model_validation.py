"""Validation of models read from files: states that no training can produce are rejected before use."""

from collections.abc import Mapping

import numpy as np

from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.loads import Pushed
from sim.tools import Ball

from ..data.cortex_patch import open_patch
from ..data.encode import ENCODERS, Basis
from ..data.indentation import IndentationPushes, add_relaxation
from ..data.tool_loads import build_rotations_about
from ..regressors.rigid_contact import RigidContact
from .conformal import LEVELS, Bound
from .held_out import HeldOutErrors
from .learned import Learned, ModelPart
from .training_range import TrainingRange

FEATURE_COUNT = 7  # Number of features of `compute_scale_features`, on which bounds depend.


def check_model_state(name: str, model: Learned) -> None:
    """Check that a model is valid: parts, training range, bounds, errors and force model.

    Raises
    ------
    InputError
        A component cannot be the result of a training; the message names it.
    """
    try:
        _require(len(model.parts) > 0, "it has no parts")
        for part in model.parts:
            _check_part(part, model)
        _check_envelope(model.envelope)
        _require(isinstance(model.bound, float) and not model.bound < 0.0, "its bound is no distance")
        _require(
            model.held_out is None or _is_valid_error(model.held_out), "its errors on held-out cortex are no errors"
        )
        texts = (*model.training, *model.training.values())
        _require(all(isinstance(text, str) for text in texts), "what it states of its training is no text")
        if model.bounds is not None:
            _check_bounds(model.bounds)
        if model.tip is not None and model.tip.bound is not None:
            _check_bounds(model.tip.bound)
        _check_force(model)
    except InputError as error:
        raise InputError(f"the model {name!r} cannot be: {error}. Make one with `sulcus train`.") from error


def check_finite_state(state: Mapping[str, np.ndarray]) -> None:
    """Check that all arrays of a regressor's state are finite numbers.

    Raises
    ------
    InputError
        An array contains other types, infinity or NaN.
    """
    for name, array in state.items():
        _require(
            array.dtype.kind in "fiub" and bool(np.isfinite(array).all()),
            f"a regressor's {name!r} are no finite numbers. Make a model with `sulcus train`.",
        )


def _check_part(part: ModelPart, model: Learned) -> None:
    _require(part.encoder in ENCODERS, f"no encoder is called {part.encoder!r}")
    _check_basis(part.basis, model.anatomy)
    features = _encode_probe_load(part.encoder, model)
    found = part.regressor.predict(features)
    _require(
        found.shape == (len(features), len(part.basis.modes)) and bool(np.isfinite(found).all()),
        "it gives no result for a load of its training",
    )


def _check_basis(basis: Basis, anatomy: Anatomy) -> None:
    nodes, modes = basis.nodes, basis.modes
    _require(nodes.ndim == 1 and nodes.dtype.kind in "iu" and len(nodes) > 0, "its nodes are no vertex numbers")
    _require(nodes.min() >= 0 and nodes.max() < len(anatomy.mesh.nodes), "its nodes lie outside the mesh")
    # Numbers increase; a basis of tumour and cortex has two increasing parts.
    rises = np.diff(nodes.astype(np.int64)) > 0
    _require(
        bool(np.sum(~rises) <= 1) and len(np.unique(nodes)) == len(nodes), "its nodes are not sorted, or come twice"
    )
    known = np.union1d(anatomy.tumour_nodes, open_patch(anatomy).nodes)
    _require(bool(np.isin(nodes, known).all()), "its nodes are none of tumour and open cortex")
    _require(modes.ndim == 2 and modes.shape[1] == 3 * len(nodes), "its modes are not those of its nodes")
    _require(modes.dtype.kind == "f" and bool(np.isfinite(modes).all()), "its modes are no finite numbers")


def _encode_probe_load(encoder: str, model: Learned) -> np.ndarray:
    """Compute the encoder's features of one load inside the training range, without integrating a footprint."""
    if encoder in ("nodal", "rooted"):
        return np.ones((1, 3 * len(open_patch(model.anatomy).nodes)))
    envelope = model.envelope
    _check_envelope(envelope)
    inward = open_patch(model.anatomy).find_normals(envelope.points[:1].astype(float))[0]
    depth, wide = envelope.force[1], envelope.footprint[1]
    pushed = Pushed(envelope.points[:1].astype(float), depth * inward[None], np.array([wide]))
    if model.tool is not None and not isinstance(model.tool, Ball):
        axes = build_rotations_about(-inward[None])
        pushed = IndentationPushes(pushed.point, pushed.force, pushed.footprint, axes, -wide * inward[None])
    if model.series:
        pushed = add_relaxation(pushed, np.zeros(1))
    return ENCODERS[encoder](open_patch(model.anatomy), pushed)


def _check_force(model: Learned) -> None:
    if model.force is None:
        return
    _require(model.tool is not None, "it knows the force of a tool that it has not")
    _require(model.force.encoder in ENCODERS, f"no encoder is called {model.force.encoder!r}")
    grips = [part.regressor.grip for part in model.parts if isinstance(part.regressor, RigidContact)]
    _require(bool(grips) or model.force.regressor is not None, "it knows nothing of its tool's force")
    terms = 4 if model.series else 2
    _require(all(grip.shape == (terms,) for grip in grips), "what it knows of its tool's force is none")
    if model.force.regressor is not None:
        found = model.force.regressor.predict(_encode_probe_load(model.force.encoder, model))
        _require(found.shape == (1, 3) and bool(np.isfinite(found).all()), "it gives no force")
    if model.force.bound is not None:
        _check_bounds(model.force.bound)


def _check_envelope(envelope: TrainingRange) -> None:
    points = envelope.points
    _require(
        points.ndim == 2 and points.shape[1] == 3 and len(points) > 0 and bool(np.isfinite(points).all()),
        "its training points are none",
    )
    for name in ("force", "footprint"):
        span = getattr(envelope, name)
        _require(len(span) == 2 and all(map(_is_positive, span)) and span[0] <= span[1], f"its range of {name} is none")
    for name in ("reach", "angle"):
        value = getattr(envelope, name)
        _require(value == 0.0 or _is_positive(value), f"its {name} is none")
    _require(bool(np.isfinite(envelope.overhang)) and _is_positive(envelope.line_force), "its range of loads is none")


def _check_bounds(bounds: Bound) -> None:
    for name, array in vars(bounds).items():
        _require(array.dtype.kind == "f" and not np.isnan(array).any(), f"{name!r} of its bounds are no numbers")
    terms = 1 + FEATURE_COUNT + FEATURE_COUNT * (FEATURE_COUNT + 1) // 2
    shapes = {
        "mean": (FEATURE_COUNT,),
        "deviation": (FEATURE_COUNT,),
        "weights": (terms,),
        "quantile": (len(LEVELS), len(bounds.edges) + 1),
        "growth": (),
        "near": (),
    }
    for name, shape in shapes.items():
        _require(getattr(bounds, name).shape == shape, f"{name!r} of its bounds have another shape")
    numbers = np.concatenate([bounds.mean, bounds.deviation, bounds.weights])
    _require(bool(np.isfinite(numbers).all() and (bounds.deviation > 0.0).all()), "the scale of its bounds is none")
    _require(bounds.edges.ndim == 1 and bool((np.diff(bounds.edges) > 0.0).all()), "its classes of force do not rise")
    _require(bool((bounds.quantile >= 0.0).all()), "its bounds are negative")
    _require(0.0 <= float(bounds.growth) < np.inf and 0.0 <= float(bounds.near) < np.inf, "its bounds do not grow")
    _require(bool((bounds.quantile[1] >= bounds.quantile[0]).all()), "its bounds shrink with their probability")


def _is_valid_error(errors: HeldOutErrors) -> bool:
    """Return True if errors on held-out cortex have possible values."""
    sizes = (errors.mean, errors.guarded, errors.solved, *([] if errors.p999 is None else [errors.p999]))
    return all(type(size) is float and 0.0 <= size < np.inf for size in sizes) and errors.solved <= 1.0


def _is_positive(value: float) -> bool:
    return 0.0 < value < np.inf


def _require(condition: bool, reason: str) -> None:
    if not condition:
        raise InputError(reason)
