"""Points, lines and curves that 3D Slicer wrote as `.mrk.json`, and points as `.fcsv`."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from ..errors import InputError
from ..runtime.file_limits import FARTHEST
from ..runtime.outside_files import read_as, to_path

SIGNS = {"LPS": (-1.0, -1.0, 1.0), "RAS": (1.0, 1.0, 1.0)}
"""What coordinates become in RAS. Slicer writes LPS, and means it where a file does not say."""
NUMBERED = {"0": "RAS", "1": "LPS"}
"""What older files say in place of these words."""
REMEDY = "Save a point, a line or a closed curve from 3D Slicer's Markups."
# Bytes of a file, points of a curve, and points that a curve is drawn with.
LARGEST, MOST, DRAWN = 2**22, 5000, 256
# In a row of `.fcsv` after a number or name: the coordinates, and whether they are placed, if it is said.
PLACE, STATUS, DEFINED = slice(1, 4), 14, "2"


@dataclass(frozen=True, eq=False)
class Markup:
    """What a file holds: its kind in Slicer's words, and its points (n, 3) [m, RAS] that are placed."""

    path: Path
    kind: str
    points: np.ndarray

    def curve(self) -> np.ndarray:
        """Points (256, 3) [m] of the smooth closed curve through the points of a `ClosedCurve`.

        Raises
        ------
        InputError
            Fewer than three points, or two that coincide.
        """
        points = np.concatenate([self.points, self.points[:1]])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(self.points) < 3 or steps.min() < 1e-6:
            raise InputError(f"{self.path}: its curve needs three points or more, each at a place of its own. {REMEDY}")
        along = np.concatenate([[0.0], np.cumsum(steps)])
        spline = CubicSpline(along, points, bc_type="periodic")
        return spline(np.linspace(0.0, along[-1], DRAWN, endpoint=False))


def read_markup(path: str | Path) -> Markup:
    """Return the markup in a `.mrk.json` file, or the points in a `.fcsv` file.

    Raises
    ------
    InputError
        A file that is none, or that has several markups. Another unit than mm, another system than LPS or RAS. No
        point that is placed, or coordinates that are no numbers.
    """
    path = to_path(path)
    with read_as(path, "markups of 3D Slicer", REMEDY):
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path}: is too large for markups. {REMEDY}")
        text = path.read_bytes().decode("utf-8-sig")
        kind, system, placed = _fcsv(text) if path.name.lower().endswith(".fcsv") else _json(text)
        if system not in SIGNS:
            said = f"its coordinate system is {system!r}" if system else "it does not state its coordinate system"
            raise InputError(f"{path}: {said}: LPS and RAS are known. {REMEDY}")
        if not 1 <= len(placed) <= MOST:
            raise InputError(f"{path}: has {len(placed)} points that are placed; 1 to {MOST} are read. {REMEDY}")
        points = np.array(placed, np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise InputError(f"{path}: has points whose coordinates are no numbers. {REMEDY}")
        if np.abs(points).max() > 1e3 * FARTHEST:
            raise InputError(f"{path}: has points more than {FARTHEST:g} m away: coordinates are in mm. {REMEDY}")
        return Markup(path, kind, 1e-3 * points * SIGNS[system])


def _json(text: str) -> tuple[str, str, list[list[float]]]:
    """Kind, coordinate system, and placed points [mm] of the one markup in a `.mrk.json` file."""
    markups = json.loads(text)["markups"]
    if len(markups) != 1:
        raise InputError(f"has {len(markups)} markups, and one is read. Save each to a file of its own.")
    (markup,) = markups
    units = markup.get("coordinateUnits", "mm")
    if set([units] if isinstance(units, str) else units) != {"mm"}:
        raise InputError(f"its coordinates are in {units}, and mm are read. {REMEDY}")
    controls = markup["controlPoints"]
    placed = [one["position"] for one in controls if one.get("positionStatus", "defined") == "defined"]
    return str(markup["type"]), str(markup.get("coordinateSystem", "LPS")), placed


def _fcsv(text: str) -> tuple[str, str, list[list[float]]]:
    """Kind, coordinate system (empty: not stated), and placed points [mm] of a `.fcsv` file.

    Its columns are id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID, and of Slicer 5 the status of the
    point, before which Slicer for Windows leaves a carriage return.
    """
    stated = re.search(r"^# *CoordinateSystem *= *(\w+)", text, re.MULTILINE)
    lines = (line for line in text.replace("\r", "").split("\n") if line.strip() and not line.startswith("#"))
    rows = list(csv.reader(lines, strict=True))
    placed = [[float(x) for x in row[PLACE]] for row in rows if row[STATUS : STATUS + 1] in ([], [DEFINED])]
    system = stated[1] if stated else ""
    return "Fiducial", NUMBERED.get(system, system), placed
