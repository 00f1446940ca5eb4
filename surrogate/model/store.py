"""Model files: one `.npz` file with plain arrays and a JSON header, without pickle."""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sim.anatomy import Anatomy
from sim.effects import Elasticity
from sim.errors import InputError
from sim.geometry.tetmesh import compute_digest
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import to_path, wrap_errors
from sim.runtime.versions import get_version
from sim.tools import read_tool_statement

from ..data.encode import Basis
from ..data.solution_rows import find_first_tissue
from ..regressors.baselines import Ann, Pcr, Svr
from ..regressors.force_series import ForcePairs, RemainderGp, Series
from ..regressors.gp import Gp
from ..regressors.protocol import FittedRegressor, Linear, Regressor
from ..regressors.rigid_contact import RigidContact
from .conformal import GROWTH, Bound
from .held_out import HeldOutErrors, ReportedErrors
from .learned import Learned, ModelPart
from .model_validation import check_finite_state, check_model_state
from .npz_archive import Archive, compute_seal, write_archive
from .own_learners import find_learner_name, find_own_learner
from .tip_distance import TipModel
from .tool_contact import ForceModel
from .training_range import TrainingRange

FORMAT = "sulcus model 2"  # Name and version of the file format.
REMEDY = "Make one with `sulcus train`."  # Remedy in error messages.
# General regressors, by name.
REGRESSORS: dict[str, type[Regressor]] = {"linear": Linear, "pcr": Pcr, "ann": Ann, "svr": Svr, "gp": Gp}
# All types of fitted parts, by name: also regressors that depend on the tool features and their meaning.
FITTED: dict[str, type[FittedRegressor]] = {
    **REGRESSORS,
    "pairs": ForcePairs,
    "series": Series,
    "remainder": RemainderGp,
    "contact": RigidContact,
}


def save(path: str | Path, models: Mapping[str, Learned]) -> None:
    """Write models of one anatomy to a file under their names, atomically.

    Raises
    ------
    InputError
        There are no models or models of different anatomies, the name does not end in .npz, or the folder is not
        writable; a state has other content than arrays of numbers or text, or a regressor is not registered.
    """
    digests = {model.anatomy.digest for model in models.values()}
    if len(digests) != 1:
        raise InputError(f"{path}: a file holds models of one anatomy, not of {len(digests)}.")
    arrays: dict[str, np.ndarray] = {}

    def store(array: np.ndarray) -> str:
        if not isinstance(array, np.ndarray) or array.dtype.hasobject:
            raise InputError(f"{path}: a learner's state holds a {type(array).__name__} that is no array of numbers.")
        name = compute_digest(array)  # parts that models share are stored once
        arrays[name] = array
        return name

    header = {
        "format": FORMAT,
        "anatomy": digests.pop(),
        "space": "RAS [m]",
        "versions": {name: get_version(name) for name in ("sulcus", "numpy")},
        "models": {name: _describe_model(model, store) for name, model in models.items()},
    }
    header["seal"] = compute_seal(header, {})  # array names are their digests
    with write_atomically(path, ".npz") as partial:
        write_archive(partial, {"header": np.array(json.dumps(header)), **arrays})


def load(path: str | Path, anatomy: Anatomy) -> dict[str, Learned]:
    """Read the models of an anatomy from a file; return them by name.

    Raises
    ------
    InputError
        The file is missing, not a model file of this project, or for another anatomy, or it contains an invalid model.

    Examples
    --------
    >>> from scenes import get_template_path
    >>> from sim import read_anatomy
    >>> from surrogate import load
    >>> path = get_template_path()
    >>> models = load(path.with_suffix(".model.npz"), read_anatomy(path))
    >>> sorted(models)
    ['ann', 'linear', 'series', 'series-gp', 'svr']
    """
    path = to_path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; make a model with `sulcus train`.")
    with wrap_errors(path, "a model", REMEDY), path.open("rb") as raw:
        archive = Archive(raw, REMEDY)
        header = _read_header(archive)
        if header["format"] != FORMAT:
            raise InputError(f"{path}: has the format {str(header['format'])[:40]!r}, not {FORMAT!r}: train it again.")
        if header["anatomy"] != anatomy.digest:
            raise InputError(
                f"{path}: was trained on the anatomy {str(header['anatomy'])[:40]}, but this one is {anatomy.digest}: "
                "use the mesh that it was made for, or run `sulcus simulate` and `sulcus train` for this one."
            )
        arrays = archive.read_by_digest(_list_array_keys(header["models"].values()))
        models = {name: _rebuild_model(description, arrays, anatomy) for name, description in header["models"].items()}
        for name, model in models.items():
            check_model_state(name, model)
        return models


def read_reported_errors(path: str | Path) -> dict[str, ReportedErrors]:
    """Read the reported errors of a file's models without their arrays; return them by model name.

    Raises
    ------
    InputError
        The file is missing, or not a model file of this project.
    """
    with _open_header(path) as header:
        return {name: ReportedErrors(about["bound"], _read_held_out(about)) for name, about in header["models"].items()}


def read_learned_tissue(path: str | Path, anatomy: Anatomy) -> Elasticity | None:
    """Read the tissue, with its regions, that a file's models were trained on; the arrays are not read.

    Return None if the file does not give the tissue, or if the models are of another anatomy.

    Raises
    ------
    InputError
        See `read_reported_errors`, or the tissue is invalid.
    """
    with _open_header(path) as header:
        if header["anatomy"] != anatomy.digest:
            return None
        return find_first_tissue(about["training"] for about in header["models"].values())


@contextmanager
def _open_header(path: str | Path) -> Iterator[dict[str, Any]]:
    """Read the header of a model file, as a context manager that adds the file's name to errors inside it."""
    path = to_path(path)
    with wrap_errors(path, "a model", REMEDY), path.open("rb") as raw:
        yield _read_header(Archive(raw, REMEDY))


def _read_header(archive: Archive) -> dict[str, Any]:
    """Read the header of a model file, and verify its seal; older files have no seal."""
    header = json.loads(archive.read_text("header"))
    if "seal" in header:
        archive.read_sealed(header, ())
    return header


def _read_held_out(description: dict[str, Any]) -> HeldOutErrors | None:
    """Read the errors on held-out cortex from a model's description; None for older files."""
    stated = description.get("left_out")
    return None if stated is None else HeldOutErrors(**stated)


def _list_array_keys(descriptions: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Yield the names of all arrays that the models' descriptions refer to."""
    for description in descriptions:
        for part in description["parts"]:
            yield from (part["nodes"], part["modes"], *part["state"].values())
        yield description["envelope"]["points"]
        tip, force = description.get("tip") or {}, description.get("force") or {}
        state = (force.get("learned") or {}).get("state")
        for named in (description["bounds"], tip.get("bound"), tip.get("correction"), force.get("bound"), state):
            yield from (named or {}).values()


def _get_own_name(regressor: FittedRegressor) -> str:
    name = find_learner_name(type(regressor))
    if name is None:
        raise InputError(f"{type(regressor).__name__} was never registered: see surrogate.learner.")
    return name


def _find_type(name: str) -> type[FittedRegressor]:
    """Return the class of a regressor named in a model file: a built-in or a user-defined class."""
    if name in FITTED:
        return FITTED[name]
    own = find_own_learner(name)
    if own is None:
        raise InputError(
            f"a model here was made by the learner {name!r}, which is not this package's own. Name the file that "
            "registers it by --plugin, or install the package that brings it."
        )
    return own.regressor


def _describe_model(model: Learned, store: Any) -> dict[str, Any]:
    parts = [
        {
            "encoder": part.encoder,
            **_describe_regressor(part.regressor, store),
            "nodes": store(part.basis.nodes),
            "modes": store(part.basis.modes),
        }
        for part in model.parts
    ]
    envelope = {**asdict(model.envelope), "points": store(model.envelope.points)}
    return {
        "parts": parts,
        "envelope": envelope,
        "bound": model.bound,
        "bounds": _describe_bound(model.bounds, store),
        "training": dict(model.training),
        "tool": None if model.tool is None else repr(model.tool),
        "tip": None if model.tip is None else _describe_tip(model.tip, store),
        "left_out": None if model.held_out is None else asdict(model.held_out),
        "force": None if model.force is None else _describe_force(model.force, store),
    }


def _describe_regressor(regressor: FittedRegressor, store: Any) -> dict[str, Any]:
    names = {kind: name for name, kind in FITTED.items()}
    state = {name: store(array) for name, array in regressor.state().items()}
    return {"regressor": names.get(type(regressor)) or _get_own_name(regressor), "state": state}


def _rebuild_regressor(description: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> FittedRegressor:
    state = {name: arrays[key] for name, key in description["state"].items()}
    check_finite_state(state)
    return _find_type(description["regressor"]).restored(state)


def _describe_force(force_model: ForceModel, store: Any) -> dict[str, Any]:
    learned = None if force_model.regressor is None else _describe_regressor(force_model.regressor, store)
    return {"encoder": force_model.encoder, "learned": learned, "bound": _describe_bound(force_model.bound, store)}


def _rebuild_force(
    description: dict[str, Any] | None, arrays: Mapping[str, np.ndarray], near: float
) -> ForceModel | None:
    if description is None:
        return None
    learned = description["learned"]
    return ForceModel(
        description["encoder"],
        None if learned is None else _rebuild_regressor(learned, arrays),
        _rebuild_bound(description["bound"], arrays, near),
    )


def _describe_tip(tip_model: TipModel, store: Any) -> dict[str, Any]:
    known = tip_model.correction
    correction = None if known is None else {name: store(array) for name, array in known.state().items()}
    return {"correction": correction, "bound": _describe_bound(tip_model.bound, store)}


def _rebuild_tip(description: dict[str, Any] | None, arrays: Mapping[str, np.ndarray], near: float) -> TipModel | None:
    if description is None:
        return None
    known = description["correction"]
    state = {} if known is None else {name: arrays[key] for name, key in known.items()}
    check_finite_state(state)
    correction = None if known is None else Gp.restored(state)
    return TipModel(correction, _rebuild_bound(description["bound"], arrays, near))


def _describe_bound(bound: Bound | None, store: Any) -> dict[str, str] | None:
    return None if bound is None else {name: store(array) for name, array in vars(bound).items()}


def _rebuild_bound(keys: dict[str, str] | None, arrays: Mapping[str, np.ndarray], near: float) -> Bound | None:
    """Rebuild a bound; a bound in an older file grows only beyond `near` [m] of the training loads."""
    if keys is None:
        return None
    older = {"growth": np.array(1e3 * GROWTH), "near": np.array(near)}
    return Bound(**(older | {name: arrays[key] for name, key in keys.items() if name != "profile"}))


def _rebuild_model(description: dict[str, Any], arrays: Mapping[str, np.ndarray], anatomy: Anatomy) -> Learned:
    parts = []
    for part in description["parts"]:
        basis = Basis(arrays[part["nodes"]], arrays[part["modes"]])
        parts.append(ModelPart(part["encoder"], _rebuild_regressor(part, arrays), basis))
    envelope = dict(description["envelope"])
    envelope["points"] = arrays[envelope["points"]]
    for name in ("force", "footprint"):
        envelope[name] = tuple(envelope[name])
    return Learned(
        anatomy=anatomy,
        parts=tuple(parts),
        envelope=TrainingRange(**envelope),
        bound=description["bound"],
        bounds=_rebuild_bound(description["bounds"], arrays, envelope["reach"]),
        training=description["training"],
        # Missing in older files.
        tool=read_tool_statement(description.get("tool"), description.get("ball")),
        tip=_rebuild_tip(description.get("tip"), arrays, envelope["reach"]),
        held_out=_read_held_out(description),
        force=_rebuild_force(description.get("force"), arrays, envelope["reach"]),
    )
