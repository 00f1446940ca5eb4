"""Observed frames with their points and pressing tools, and the CSV table of the tools."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points

from ..locating.observation import LIMITS, Observation, to_evidence
from ..locating.observed_files import PLACE, SIGMA, read_columns

DEFAULT_RADIUS = 6e-3
"""Default radius [m] of the disc on which a tool presses."""
RADIUS_RANGE = (0.5e-3, 30e-3)  # Smallest and largest tool radius [m].
MAX_FORCE = 10.0  # Largest force of a tool on a brain [N].
FORCE_SIGMA = 0.1
"""Default standard deviation of a measured force, as a share of the force."""
# Column names: number of the frame, radius of the tool, force.
FRAME_COLUMN, RADIUS_COLUMN, FORCE_COLUMN = "frame", "radius", "force"
ALLOWED_COLUMNS = {  # Allowed combinations of columns.
    (FRAME_COLUMN, *PLACE, *more)
    for more in (
        (),
        (RADIUS_COLUMN,),
        (FORCE_COLUMN,),
        (RADIUS_COLUMN, FORCE_COLUMN),
        (FORCE_COLUMN, SIGMA),
        (RADIUS_COLUMN, FORCE_COLUMN, SIGMA),
    )
}
OPTIONAL_COLUMNS = (RADIUS_COLUMN, FORCE_COLUMN, SIGMA)  # Columns whose cells may be empty.


@dataclass(frozen=True)
class Tool:
    """Observed tool that presses on the open cortex.

    Parameters
    ----------
    tip
        Contact position (3,) [m] of the tool's tip, RAS.
    radius
        Radius [m] of the disc on which the tool presses.
    force, sigma
        Force [N] and its standard deviation [N]; None: not measured.
    """

    tip: tuple[float, float, float]
    radius: float = DEFAULT_RADIUS
    force: float | None = None
    sigma: float | None = None


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """Observation and the tools that pressed during the observation; in a frame without tools, fluid has drained."""

    observation: Observation
    tools: tuple[Tool, ...] = ()


def check_frames(anatomy: Anatomy, frames: Sequence[ObservedFrame]) -> None:
    """Check that frames can be used to fit the tissue of an anatomy.

    Raises
    ------
    InputError
        There are no frames, or two equal ones; a frame is invalid for `to_evidence` or a point cloud; a tool is far
        from the open cortex, or has an invalid radius or force.
    """
    if not frames:
        raise InputError("there is no frame to fit tissue to: give what was seen of the open cortex, a file a frame.")
    for number, frame in enumerate(frames, start=1):
        try:
            if frame.observation.rest is None:
                raise InputError("is a cloud, whose points have no names: give points and how they moved.")
            to_evidence(anatomy, frame.observation)
            for tool in frame.tools:
                _check_tool(anatomy, tool)
            if len(frame.tools) > 1 and any(tool.force is not None for tool in frame.tools):
                raise InputError("a force is read while several tools press: read it while one presses alone.")
        except InputError as error:
            raise InputError(f"frame {number}: {error}") from error
    order = sorted(range(len(frames)), key=lambda number: frames[number].observation.now.tobytes())
    for one, other in pairwise(order):
        if np.array_equal(frames[one].observation.now, frames[other].observation.now):
            first, second = sorted((one + 1, other + 1))
            raise InputError(f"frames {first} and {second} are the same, which would count twice: leave one out.")


def find_contact_point(anatomy: Anatomy, tool: Tool) -> np.ndarray:
    """Return the point (3,) [m] of the undeformed open cortex that is nearest to a tool's tip."""
    return find_closest_points(np.array([tool.tip]), open_cortex(anatomy).corners).point[0]


def _check_tool(anatomy: Anatomy, tool: Tool) -> None:
    numbers = [*tool.tip, tool.radius, tool.force or 0.0, tool.sigma or 0.0]
    if not np.isfinite(numbers).all():
        raise InputError("a tool has a number that is not finite: leave it out.")
    away = float(np.linalg.norm(find_contact_point(anatomy, tool) - tool.tip))
    if away > LIMITS.far_distance_now:
        raise InputError(
            f"a tool is {1e3 * away:.0f} mm from the open cortex, so that it cannot press on it: give millimetres, "
            "RAS, or leave it out."
        )
    if not RADIUS_RANGE[0] <= tool.radius <= RADIUS_RANGE[1]:
        raise InputError(
            f"a tool of radius {1e3 * tool.radius:g} mm presses on no disc of a brain: give "
            f"{1e3 * RADIUS_RANGE[0]:g} to {1e3 * RADIUS_RANGE[1]:g} mm."
        )
    if tool.force is not None and not 0.0 < tool.force <= MAX_FORCE:
        raise InputError(
            f"a force of {tool.force:g} N is none of a tool on a brain: give newtons, up to {MAX_FORCE:g}."
        )
    if tool.sigma is not None and (tool.force is None or not tool.sigma > 0.0):
        raise InputError("a force's sigma needs a force, and is positive: give both in newtons, or neither.")


def read_tools(path: str | Path, frames: int) -> tuple[tuple[Tool, ...], ...]:
    """Read a CSV table `frame,x,y,z[,radius][,force[,sigma]]`: the tools of each of `frames` frames, numbered from 1.

    Cells of radius, force and sigma may be empty: then the radius is the default, and the force is not measured.

    Raises
    ------
    InputError
        The file is missing or not such a table, or a frame number does not exist.
    """
    columns = read_columns(path, ALLOWED_COLUMNS, OPTIONAL_COLUMNS)
    found: list[list[Tool]] = [[] for _ in range(frames)]
    for row, number in enumerate(columns[FRAME_COLUMN]):
        if number not in range(1, frames + 1):
            raise InputError(
                f"{path}: row {row + 2} is of frame {number:g}, but there are {frames}: they count from 1."
            )
        radius, force, sigma = (
            None if name not in columns or np.isnan(columns[name][row]) else float(columns[name][row])
            for name in OPTIONAL_COLUMNS
        )
        x, y, z = (1e-3 * float(columns[name][row]) for name in PLACE)
        found[int(number) - 1].append(
            Tool((x, y, z), DEFAULT_RADIUS if radius is None else 1e-3 * radius, force, sigma)
        )
    return tuple(map(tuple, found))
