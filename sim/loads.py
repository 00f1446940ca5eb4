"""Loads: a batch of load cases, each a sum of causes that act on tissue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from .arguments import as_array, check_numbers_array
from .errors import InputError


@dataclass(frozen=True, eq=False)
class Pushed:
    """Dead traction t on a round footprint: t(x) = F w(|x - c| / r) / (integral of w), with w(s) = sqrt(1 - s^2).

    `point` c (B, 3) [m] in the undeformed configuration, `force` F (B, 3) [N], and `footprint` radius r (B,) [m].
    """

    point: np.ndarray
    force: np.ndarray
    footprint: np.ndarray


@dataclass(frozen=True, eq=False)
class Displaced:
    """Prescribed mean displacement of the tissue under a tool's footprint, weighted by w as in `Pushed`.

    The required force is reported as the reaction; a `Pushed` load with this force gives the same deformation.
    `point` (B, 3) [m], `displacement` (B, 3) [m], and `footprint` radius (B,) [m].
    """

    point: np.ndarray
    displacement: np.ndarray
    footprint: np.ndarray


@dataclass(frozen=True, eq=False)
class Nodal:
    """Dead forces (B, V, 3) [N] at the mesh vertices."""

    force: np.ndarray


@dataclass(frozen=True, eq=False)
class Prescribed:
    """Prescribed displacement (B, V, 3) [m] of fixed components; entries of components that are free are ignored."""

    displacement: np.ndarray


@dataclass(frozen=True, eq=False)
class Posture:
    """Current direction of gravity and fluid level of the head; `Gravity` defines both for the time of the scan.

    `direction` (B, 3) of gravity in mesh coordinates, nonzero. `csf_level` (B,) [m] above the origin, measured against
    `direction`. `share` (B,): fraction of the change of weight since the scan that acts; scaling a load changes only
    this fraction, so a scaled load does not correspond to another posture. In the posture of the scan the force is 0.
    """

    direction: np.ndarray
    csf_level: np.ndarray
    share: np.ndarray


@dataclass(frozen=True, eq=False)
class Resected:
    """Number `done` (B,) of completed steps of the effect `Resection`, as integers; load scaling does not change it."""

    done: np.ndarray


@dataclass(frozen=True, eq=False)
class Touching:
    """Poses of the tools of `ToolContact`, in the same order: T_world_tool `pose` (B, tools, 4, 4).

    A tool moves straight from its pose in the start solution or, without it, along its shaft from outside the body.
    """

    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class Retracted:
    """Retractor placed at T_world_tool `pose` (B, 4, 4), clear of tissue, then moved by `displacement` (B, 3) [m]."""

    pose: np.ndarray
    displacement: np.ndarray


class OwnCause(Protocol):
    """Interface of causes of user-defined effects: frozen dataclasses (eq=False) with arrays (B, ...), B load cases."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def magnitude(self) -> str | None:
        """Name of the array that load stepping scales; None if no array scales with the load."""
        ...


BuiltIn = Pushed | Displaced | Nodal | Prescribed | Posture | Resected | Touching | Retracted  # causes of this package
Cause = BuiltIn | OwnCause  # all causes
C = TypeVar("C", bound=Cause)
# Array of each cause that scales with the load; the others give its location. Tools move with `Cases.share`.
MAGNITUDE = {Pushed: "force", Displaced: "displacement", Nodal: "force", Prescribed: "displacement", Posture: "share"}
# arrays with one number per load case
SCALARS = ("footprint", "csf_level", "share", "done")
MIN_FOOTPRINT = 1e-4  # minimum footprint radius [m], below a needle's tip
MAX_FOOTPRINT = 0.1  # maximum footprint radius [m], covers a brain
# Minimum length of a vector, so that its square does not underflow.
MIN_VECTOR_LENGTH = 1e-100
# Maximum deviation of a pose's 3 x 3 block from a rotation.
ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Loads:
    """Batch of B load cases, each the sum of all causes; without causes only the time changes.

    `Pushed` may occur several times, once per pushing tool; every other type may occur only once.

    Parameters
    ----------
    causes
        `Pushed`, `Displaced`, `Nodal`, `Prescribed`, `Posture`, `Resected`, `Touching`, `Retracted`, or an `OwnCause`.
    time
        Time (B,) [s] of the solution; 0 if no effect depends on time.

    Raises
    ------
    InputError
        Neither a cause nor a time is given, a value is not a cause, or a type other than `Pushed` occurs twice. Arrays
        are not real and finite, have wrong shapes or unequal numbers of rows, or a footprint is outside 0.1 to 100 mm.
    """

    causes: tuple[Cause, ...]
    time: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.causes, tuple | list):
            known = ", ".join(kind.__name__ for kind in BuiltIn.__args__)
            raise InputError(f"Loads.causes is {self.causes!r:.80}: give a tuple of {known}.")
        kinds = [type(cause) for cause in self.causes]
        single = [kind for kind in kinds if kind is not Pushed]
        if len(set(single)) < len(single) or not (kinds or self.time is not None):
            names = ", ".join(kind.__name__ for kind in kinds) or "none"
            raise InputError(
                f"loads have the causes {names}: give at least one, or a time, and each kind but Pushed once."
            )
        object.__setattr__(self, "causes", tuple(_check_cause(cause) for cause in self.causes))
        rows = {len(array) for cause in self.causes for array in vars(cause).values()}
        time = np.zeros(max(rows)) if self.time is None else check_numbers_array("Loads.time", self.time)
        if time.ndim != 1:
            raise InputError(f"Loads.time has shape {time.shape}: give (B,) [s].")
        if rows - {len(time)}:
            raise InputError(f"load arrays have {sorted(rows | {len(time)})} rows: give one row per load case.")
        object.__setattr__(self, "time", time)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def times(self) -> np.ndarray:
        """Time (B,) [s] of each load case."""
        assert self.time is not None
        return self.time

    def get(self, kind: type[C]) -> C | None:
        """Return the only cause of the type `kind`; None if there is no such cause.

        Raises
        ------
        InputError
            Several causes are of this type.
        """
        found = self.get_all(kind)
        if len(found) > 1:
            raise InputError(f"the loads have {len(found)} causes {kind.__name__}, but one is supported: give one.")
        return found[0] if found else None

    def get_all(self, kind: type[C]) -> tuple[C, ...]:
        """Return all causes of the type `kind`."""
        return tuple(cause for cause in self.causes if isinstance(cause, kind))

    def drop(self, kind: type[Cause]) -> Loads:
        """Return the loads without the causes of the type `kind`."""
        return Loads(tuple(cause for cause in self.causes if not isinstance(cause, kind)), self.times)

    def get_only(self, kind: type[C]) -> C | None:
        """Return the cause if there is exactly one cause and its type is `kind`; else None."""
        return self.get(kind) if len(self.causes) == 1 else None

    def select(self, index: slice | np.ndarray) -> Loads:
        """Return the load cases selected by `index`: a slice, numbers or a mask."""
        return Loads(tuple(select_cases(cause, index) for cause in self.causes), self.times[index])

    def scale(self, fraction: float | np.ndarray) -> Loads:
        """Return the loads with the magnitudes of all causes multiplied by `fraction`, a scalar or (B,)."""

        def scale_cause(cause: Cause) -> Any:
            name = MAGNITUDE.get(type(cause)) if isinstance(cause, BuiltIn) else cause.magnitude
            if name is None:
                return cause
            array = getattr(cause, name)
            factor = np.broadcast_to(fraction, len(array)).reshape(-1, *[1] * (array.ndim - 1))
            return replace(cause, **{name: factor * array})

        return Loads(tuple(scale_cause(cause) for cause in self.causes), self.times)

    # Former names, for one release.
    of, every, without_kind, only, rows, scaled = get, get_all, drop, get_only, select, scale


def select_cases(cause: C, index: slice | np.ndarray) -> C:
    """Return the rows of a cause for the load cases selected by `index`: a slice, numbers or a mask (B,)."""
    return replace(cause, **{item.name: getattr(cause, item.name)[index] for item in fields(cause)})


def stack(parts: Sequence[Loads]) -> Loads:
    """Return all load cases of several loads in one batch.

    Raises
    ------
    InputError
        There are no loads, or the loads have different types of causes.
    """
    kinds = {tuple(type(cause) for cause in part.causes) for part in parts}
    if len(kinds) != 1:
        raise InputError(f"loads of {len(kinds)} different sets of causes cannot be stacked: give them the same kinds.")

    def join(causes: Sequence[Cause]) -> Cause:
        names = [item.name for item in fields(causes[0])]
        return replace(
            causes[0], **{name: np.concatenate([getattr(cause, name) for cause in causes]) for name in names}
        )

    causes = tuple(join(same) for same in zip(*(part.causes for part in parts), strict=True))
    return Loads(causes, np.concatenate([part.times for part in parts]))


def check_loads(loads: object) -> None:
    """Reject a value that is not `Loads`.

    Raises
    ------
    InputError
        The value is not `Loads`; the message shows the value.
    """
    if not isinstance(loads, Loads):
        raise InputError(f"loads is {loads!r:.80}: give Loads, such as push(...) makes.")


def push(point: np.ndarray, force: np.ndarray, footprint: float | np.ndarray) -> Loads:
    """Return loads of one pushing tool: point (3,) or (B, 3) [m], force (3,) or (B, 3) [N], footprint radius [m].

    Raises
    ------
    InputError
        See `Loads`.

    Examples
    --------
    >>> from sim import push
    >>> loads = push(np.zeros(3), force=np.array([[0, 0, -0.1], [0, 0, -0.2]]), footprint=7e-3)
    >>> len(loads)  # the point and the radius are common to both load cases
    2
    """
    rows = _repeat_rows("Pushed", point=(point, (3,)), force=(force, (3,)), footprint=(footprint, ()))
    return Loads((Pushed(**rows),))


def build_posture(direction: np.ndarray, csf_level: float | np.ndarray) -> Loads:
    """Return gravity loads, with the full change since the scan: direction (3,) or (B, 3), csf_level () or (B,) [m].

    Raises
    ------
    InputError
        See `Loads`.
    """
    rows = _repeat_rows("Posture", direction=(direction, (3,)), csf_level=(csf_level, ()), share=(1.0, ()))
    return Loads((Posture(**rows),))


def check_field(name: str, field: np.ndarray, vertices: int) -> None:
    """Reject a field (B, V, 3) whose number of vertices V differs from `vertices`, that of the mesh.

    Raises
    ------
    InputError
        The numbers differ; the message gives `name` and both numbers.
    """
    if field.shape[1] != vertices:
        raise InputError(f"{name} has {field.shape[1]} vertices, but the mesh has {vertices}.")


def _repeat_rows(name: str, **given: tuple[object, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Return the arrays of a cause by name, from values and shapes per case. Single values apply to all cases."""
    arrays = {}
    for key, (values, shape) in given.items():
        array = as_array(f"{name}.{key}", values)
        if array.shape == shape:
            array = array[None]
        if array.ndim == 0 or array.shape[1:] != shape:
            one, all_rows = ("a number", "(B,)") if not shape else ("(3,)", "(B, 3)")
            raise InputError(f"{name}.{key} has shape {array.shape}: give {one} or {all_rows}.")
        arrays[key] = array
    counts = {len(array) for array in arrays.values()} - {1}
    if len(counts) > 1:
        stated = ", ".join(f"{key} {len(array)}" for key, array in arrays.items())
        raise InputError(f"{name} has rows of {stated}: give each one row, or one for each load case.")
    rows = counts.pop() if counts else 1
    # Broadcasting takes longer than the remainder of `push`.
    return {
        key: array if len(array) == rows else np.broadcast_to(array, (rows, *array.shape[1:]))
        for key, array in arrays.items()
    }


def _check_cause(cause: Cause) -> Cause:
    name = type(cause).__name__
    if not isinstance(cause, BuiltIn) and not (is_dataclass(cause) and hasattr(cause, "magnitude")):
        allowed = ", ".join(kind.__name__ for kind in BuiltIn.__args__)
        raise InputError(
            f"{name} is no cause: choose from {allowed}; or make your own as sim.OwnCause says, with a magnitude."
        )
    arrays = {key: check_numbers_array(f"{name}.{key}", value) for key, value in vars(cause).items()}
    whole_field = isinstance(cause, Nodal | Prescribed)
    for key, array in arrays.items():
        if key == "pose":
            _check_poses(name, array, 4 if isinstance(cause, Touching) else 3)
            continue
        scalar_rows = key in SCALARS
        good = array.ndim == (1 if scalar_rows else 3 if whole_field else 2)
        if not isinstance(cause, BuiltIn):
            if not array.ndim:
                raise InputError(f"{name}.{key} is one number: give a row per load case, (B, ...).")
        elif not good or (not scalar_rows and array.shape[-1] != 3):
            want = "(B,)" if scalar_rows else "(B, V, 3)" if whole_field else "(B, 3)"
            raise InputError(f"{name}.{key} has shape {array.shape}: give {want}.")
        if key == "footprint" and len(array):
            for radius in (array.min(), array.max()):
                if not MIN_FOOTPRINT <= radius <= MAX_FOOTPRINT:
                    raise InputError(
                        f"{name}.{key} has a radius of {radius:g} m: give positive radii in metres, from "
                        f"{MIN_FOOTPRINT:g} to {MAX_FOOTPRINT:g} (7 mm are 0.007)."
                    )
        if key == "done" and ((array < 0.0) | (array % 1.0 != 0.0)).any():
            raise InputError(f"{name}.{key} is {array}: must be numbers of completed steps, integers >= 0.")
        if key == "direction" and not (np.abs(array).max(axis=1) >= MIN_VECTOR_LENGTH).all():
            raise InputError(f"{name}.{key} has a row of zeros: give the direction of gravity for every load case.")
    return type(cause)(**arrays)


def _check_poses(name: str, pose: np.ndarray, axes: int) -> None:
    """Reject a `pose` array that does not have `axes` axes, or contains a matrix that is not a rigid transformation."""
    if pose.ndim != axes or pose.shape[-2:] != (4, 4):
        raise InputError(
            f"{name}.pose has shape {pose.shape}: give {'(B, tools, 4, 4)' if axes == 4 else '(B, 4, 4)'}."
        )
    turn = pose[..., :3, :3]
    off = np.abs(turn @ turn.swapaxes(-1, -2) - np.eye(3)).max(initial=0.0)
    if off > ROTATION_TOLERANCE or (np.linalg.det(turn) < 0.0).any() or (pose[..., 3, :] != [0.0, 0.0, 0.0, 1.0]).any():
        raise InputError(
            f"{name}.pose has a matrix that is no rigid motion: give rotations of determinant 1, lengths in metres, "
            "and 0 0 0 1 as the last row."
        )
