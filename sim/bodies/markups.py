"""Points, lines and curves that 3D Slicer wrote as `.mrk.json`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from ..errors import InputError
from ..runtime.outside_files import path_of, read_as

SIGNS = {"LPS": (-1.0, -1.0, 1.0), "RAS": (1.0, 1.0, 1.0)}
"""What coordinates become in RAS. Slicer writes LPS, and means it where a file does not say."""
REMEDY = "Save a point, a line or a closed curve from 3D Slicer's Markups."
# Bytes of a file, points of a curve, and points that a curve is drawn with.
LARGEST, MOST, DRAWN = 2**22, 5000, 256


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
    """The markup in a `.mrk.json` file.

    Raises
    ------
    InputError
        A file that is none, or that has several markups. Another unit than mm, another system than LPS or RAS. No
        point that is placed, or coordinates that are no numbers.
    """
    path = path_of(path)
    with read_as(path, "markups of 3D Slicer", REMEDY):
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path}: is too large for markups. {REMEDY}")
        markups = json.loads(path.read_text("utf-8"))["markups"]
        if len(markups) != 1:
            raise InputError(f"{path}: has {len(markups)} markups, and one is read. Save each to a file of its own.")
        (markup,) = markups
        system = str(markup.get("coordinateSystem", "LPS"))
        if system not in SIGNS:
            raise InputError(f"{path}: its coordinate system is {system!r}: LPS and RAS are known. {REMEDY}")
        units = markup.get("coordinateUnits", "mm")
        if set([units] if isinstance(units, str) else units) != {"mm"}:
            raise InputError(f"{path}: its coordinates are in {units}, and mm are read. {REMEDY}")
        placed = [
            one["position"] for one in markup["controlPoints"] if one.get("positionStatus", "defined") == "defined"
        ]
        if not 1 <= len(placed) <= MOST:
            raise InputError(f"{path}: has {len(placed)} points that are placed; 1 to {MOST} are read. {REMEDY}")
        points = np.array(placed, np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise InputError(f"{path}: has points whose coordinates are no numbers. {REMEDY}")
        return Markup(path, str(markup["type"]), 1e-3 * points * SIGNS[system])
