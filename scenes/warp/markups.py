"""Writer of points and lines as markups of 3D Slicer (JSON, in millimetres, LPS)."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sim.bodies.voxels import LPS

SCHEMA = (  # Address of Slicer's schema of markups.
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


def write_markups(path: Path, markup_type: str, points: Mapping[str, np.ndarray]) -> None:
    """Write labelled points (3,) [m, RAS]; `markup_type` is "Fiducial" for a list of points, "Line" for two."""
    controls = [
        {
            "id": str(number),
            "label": label,
            "position": [round(float(value), 6) + 0.0 for value in 1e3 * point * LPS],
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for number, (label, point) in enumerate(points.items(), 1)
    ]
    markup: dict[str, object] = {
        "type": markup_type,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "controlPoints": controls,
    }
    if markup_type == "Line":
        first, second = points.values()
        length = 1e3 * float(np.linalg.norm(second - first))
        markup["measurements"] = [
            {"name": "length", "enabled": True, "value": length, "units": "mm", "printFormat": "%-#4.4g%s"}
        ]
    path.write_text(json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=1) + "\n")
