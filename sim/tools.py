"""Rigid tools. A tool is the set of points within a radius of its core: a point, a line, a rectangle or a box.

User-defined tools may be unions of several such sets.

In tool coordinates the origin is the lowest point of the tool, and the shaft points along +z.
"""

import ast
import math
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np

from .errors import InputError

# Sine of the angle below which an edge counts as perpendicular to a direction.
PERPENDICULAR_TOLERANCE = 1e-6


def _check_sizes(tool: object) -> None:
    for item in fields(tool):  # pyright: ignore[reportArgumentType]
        value = getattr(tool, item.name)
        if not 0.0 < value < math.inf:
            raise InputError(f"{type(tool).__name__}.{item.name} is {value} m: give a positive number.")


@dataclass(frozen=True)
class Ball:
    """Ball of `radius` [m], with its centre on the shaft at the height `radius` above the origin.

    Raises
    ------
    InputError
        A size that is not positive.
    """

    radius: float

    def __post_init__(self) -> None:
        _check_sizes(self)


@dataclass(frozen=True)
class Capsule:
    """Round rod along the shaft with hemispherical ends: all points within `radius` [m] of a line of `length` [m].

    Raises
    ------
    InputError
        A size that is not positive.
    """

    radius: float
    length: float

    def __post_init__(self) -> None:
        _check_sizes(self)


@dataclass(frozen=True)
class Spatula:
    """Flat blade perpendicular to the shaft: `width` [m] along x, `length` [m] along y, thickness 2 x `edge` [m].

    The sizes include the rounded edge.

    Raises
    ------
    InputError
        A size is not positive, or the blade is narrower than its rounded edges.
    """

    width: float
    length: float
    edge: float

    def __post_init__(self) -> None:
        _check_sizes(self)
        if 2.0 * self.edge > min(self.width, self.length):
            raise InputError(
                f"a Spatula of {1e3 * self.width:g} x {1e3 * self.length:g} mm has no room for round edges of "
                f"{1e3 * self.edge:g} mm: increase its size, or reduce the radius."
            )


BuiltIn = Ball | Capsule | Spatula  # tools of this package


@dataclass(frozen=True, eq=False)
class Core:
    """Box with `centre` (3,) and half sizes `half` (3,) [m], possibly 0; a tool is all points within `radius` [m]."""

    centre: np.ndarray
    half: np.ndarray
    radius: float

    @property
    def corners(self) -> np.ndarray:
        """Distinct corners (n, 3) [m] of the box; fewer than eight if a half size is 0."""
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
        return np.unique(self.centre + signs * self.half, axis=0)

    @property
    def extent(self) -> float:
        """Upper bound [m] of the distance from the origin of the tool to its farthest point."""
        return float(np.linalg.norm(np.abs(self.centre) + self.half)) + self.radius


@runtime_checkable
class OwnTool(Protocol):
    """Interface of user-defined tools: frozen dataclasses that describe a rigid tool as the union of several cores."""

    @property
    def cores(self) -> tuple[Core, ...]:
        """Cores of the tool, which may overlap. The origin is the lowest point; the shaft points along +z."""
        ...


Tool = BuiltIn | OwnTool  # all tools


def parse_tool(text: str) -> BuiltIn:
    """Return the tool whose `repr` is `text`. The text is parsed but never evaluated, so it may be untrusted.

    Raises
    ------
    InputError
        The text does not describe a tool of `BuiltIn`, or its sizes are invalid.
    """
    kinds = {kind.__name__: kind for kind in BuiltIn.__args__}
    with suppress(SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        match ast.parse(text, mode="eval").body:
            case ast.Call(ast.Name(name), [], sizes) if name in kinds:
                return kinds[name](**{str(item.arg): float(ast.literal_eval(item.value)) for item in sizes})
    raise InputError(f"{text[:60]!r} is no tool: give one of {', '.join(kinds)} with its sizes in metres.")


def read_tool_statement(text: str | None, ball: object) -> BuiltIn | None:
    """Return the tool of a file: from its `repr` in `text`, or from the radius [m] of a `ball` in older files, or None.

    Raises
    ------
    InputError
        See `parse_tool`.
    """
    if text is None and ball is None:
        return None
    return parse_tool(f"Ball(radius={ball})" if text is None else text)


def name_tool(tool: Tool) -> str:
    """Return the name of a tool with its sizes in millimetres; for a user-defined tool, its `repr`."""
    match tool:
        case Ball(radius):
            return f"a ball of {1e3 * radius:g} mm"
        case Capsule(radius, length):
            return f"a rod of {1e3 * radius:g} mm radius and {1e3 * length:g} mm length"
        case Spatula(width, length, edge):
            return f"a blade of {1e3 * width:g} x {1e3 * length:g} mm, its edge of {1e3 * edge:g} mm"
        case _:
            return repr(tool)


def check_tool(effect: str, tool: object) -> None:
    """Reject a value that is not a valid tool.

    Raises
    ------
    InputError
        The value is of another type or has no cores, or a core is not finite or has no positive radius.
    """
    if not isinstance(tool, Tool):
        allowed = ", ".join(kind.__name__ for kind in BuiltIn.__args__)
        raise InputError(f"{effect} has {tool!r} for a tool: choose from {allowed}, or give one that has cores.")
    cores = list_cores(tool)
    for core in cores:
        if not (np.isfinite([*core.centre, *core.half, core.radius]).all() and core.radius > 0.0):
            raise InputError(f"{tool!r} has a core that is not finite or has no radius: give a positive one in metres.")
    if not cores:
        raise InputError(f"{tool!r} has no cores: give at least one.")


def list_cores(tool: Tool) -> tuple[Core, ...]:
    """Return the cores of a tool."""
    return (get_core(tool),) if isinstance(tool, BuiltIn) else tuple(tool.cores)


def get_core(tool: BuiltIn) -> Core:
    """Return the core of a built-in tool."""
    match tool:
        case Ball(radius):
            return Core(np.array([0.0, 0.0, radius]), np.zeros(3), radius)
        case Capsule(radius, length):
            return Core(np.array([0.0, 0.0, radius + 0.5 * length]), np.array([0.0, 0.0, 0.5 * length]), radius)
        case Spatula(width, length, edge):
            return Core(np.array([0.0, 0.0, edge]), np.array([0.5 * width - edge, 0.5 * length - edge, 0.0]), edge)


def compute_extent(tool: Tool) -> float:
    """Return an upper bound [m] of the distance from the origin of a tool to its farthest point."""
    return max(core.extent for core in list_cores(tool))


def find_foremost_points(tool: BuiltIn, pose: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the point (B, 3) [m] of a tool at T_world_tool `pose` (B, 4, 4) farthest in a unit `direction` (3,).

    If all points of an edge or a face are equally far, the point is the centre of this edge or face.
    """
    core, local = get_core(tool), np.einsum("bji,j->bi", pose[:, :3, :3], direction)
    corner = core.centre + np.where(np.abs(local) < PERPENDICULAR_TOLERANCE, 0.0, np.sign(local)) * core.half
    return pose[:, :3, 3] + np.einsum("bij,bj->bi", pose[:, :3, :3], corner) + core.radius * direction


def compute_distances(tool: Tool, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return signed distances (n,) [m] of points (n, 3) [m] from a tool at T_world_tool `pose` (4, 4): < 0 inside."""
    local, distances = (points - pose[:3, 3]) @ pose[:3, :3], []
    for core in list_cores(tool):
        own = local - core.centre
        distances.append(np.linalg.norm(own - np.clip(own, -core.half, core.half), axis=1) - core.radius)
    return np.min(distances, axis=0)
