"""Reader for 3D Slicer markups: points, lines and curves in `.mrk.json`, and points in `.fcsv`."""

import csv
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from ..errors import InputError
from ..runtime.file_limits import MAX_COORDINATE
from ..runtime.outside_files import to_path, wrap_errors

SIGNS = {"LPS": (-1.0, -1.0, 1.0), "RAS": (1.0, 1.0, 1.0)}
"""Sign of each coordinate in the conversion to RAS, by coordinate system; the default of Slicer files is LPS."""
NUMBERED = {"0": "RAS", "1": "LPS"}
"""Coordinate system by its code in older files."""
REMEDY = "Save a point, a line or a closed curve from 3D Slicer's Markups."
MAX_FILE_SIZE = 2**22  # maximum file size [bytes]
MAX_POINTS = 5000  # maximum points of a markup
CURVE_POINTS = 256  # points of a sampled curve
POSITION = slice(1, 4)  # columns of the coordinates in a row of `.fcsv`
STATUS = 14  # column of the optional position status
DEFINED = "2"  # position status of a placed point


@dataclass(frozen=True, eq=False)
class Markup:
    """Markup of a file: its kind as named by Slicer, and its defined points (n, 3) [m, RAS]."""

    path: Path
    kind: str
    points: np.ndarray

    def fit_curve(self) -> np.ndarray:
        """Return 256 points (256, 3) [m] on the smooth closed curve through the points of a `ClosedCurve`.

        Raises
        ------
        InputError
            There are fewer than three points, or two consecutive points coincide.
        """
        points = np.concatenate([self.points, self.points[:1]])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(self.points) < 3 or steps.min() < 1e-6:
            raise InputError(f"{self.path}: its curve needs at least three distinct points. {REMEDY}")
        along = np.concatenate([[0.0], np.cumsum(steps)])
        spline = CubicSpline(along, points, bc_type="periodic")
        return spline(np.linspace(0.0, along[-1], CURVE_POINTS, endpoint=False))


def read_markup(path: str | Path) -> Markup:
    """Return the markup in a `.mrk.json` file, or the points in a `.fcsv` file.

    Raises
    ------
    InputError
        The file is not a markup file or has several markups. The unit is not mm, or the coordinate system is neither
        LPS nor RAS. No point is defined, or a coordinate is not finite.
    """
    path = to_path(path)
    with wrap_errors(path, "markups of 3D Slicer", REMEDY):
        if path.stat().st_size > MAX_FILE_SIZE:
            raise InputError(f"{path}: is too large for markups. {REMEDY}")
        text = path.read_bytes().decode("utf-8-sig")
        kind, system, placed = _parse_fcsv(text) if path.name.lower().endswith(".fcsv") else _parse_json(text)
        if system not in SIGNS:
            said = f"its coordinate system is {system!r}" if system else "it does not state its coordinate system"
            raise InputError(f"{path}: {said}: it must be LPS or RAS. {REMEDY}")
        if not 1 <= len(placed) <= MAX_POINTS:
            raise InputError(f"{path}: has {len(placed)} placed points; must be 1 to {MAX_POINTS}. {REMEDY}")
        points = np.array(placed, np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise InputError(f"{path}: has points with non-finite coordinates. {REMEDY}")
        if np.abs(points).max() > 1e3 * MAX_COORDINATE:
            raise InputError(f"{path}: has points more than {MAX_COORDINATE:g} m away: coordinates are in mm. {REMEDY}")
        return Markup(path, kind, 1e-3 * points * SIGNS[system])


def _parse_json(text: str) -> tuple[str, str, list[list[float]]]:
    """Return the kind, the coordinate system and the defined points [mm] of the only markup in a `.mrk.json` file."""
    markups = json.loads(text)["markups"]
    if len(markups) != 1:
        raise InputError(f"has {len(markups)} markups; only one is supported. Save each in a separate file.")
    (markup,) = markups
    units = markup.get("coordinateUnits", "mm")
    if set([units] if isinstance(units, str) else units) != {"mm"}:
        raise InputError(f"its coordinates are in {units}; must be mm. {REMEDY}")
    controls = markup["controlPoints"]
    placed = [one["position"] for one in controls if one.get("positionStatus", "defined") == "defined"]
    return str(markup["type"]), str(markup.get("coordinateSystem", "LPS")), placed


def _parse_fcsv(text: str) -> tuple[str, str, list[list[float]]]:
    """Return the kind, the coordinate system (empty if not given) and the defined points [mm] of a `.fcsv` file.

    The columns are id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID. Slicer 5 adds the position status;
    Slicer for Windows writes a carriage return before this status.
    """
    stated = re.search(r"^# *CoordinateSystem *= *(\w+)", text, re.MULTILINE)
    lines = (line for line in text.replace("\r", "").split("\n") if line.strip() and not line.startswith("#"))
    rows = list(csv.reader(lines, strict=True))
    placed = [[float(x) for x in row[POSITION]] for row in rows if row[STATUS : STATUS + 1] in ([], [DEFINED])]
    system = stated[1] if stated else ""
    return "Fiducial", NUMBERED.get(system, system), placed
