"""What moved a brain: in words, and as a record for programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim.loads import Loads, Pushed

from ..script.scene import Scene


@dataclass(frozen=True, eq=False)
class Cause:
    """What moved a brain: words, and a record of its `kind` and of what is known of it."""

    words: str
    record: Mapping[str, Any]

    def by(self, solver: str) -> Cause:
        """The same, as a solver answered it."""
        return replace(self, words=f"{self.words}, by {solver}")


def scene_cause(scene: Scene, number: int) -> Cause:
    """A moment of a scene, by the number of its frame."""
    time = float(scene.times[number])
    record = {"kind": "scene", "scene": scene.name, "frame": number, "time_s": time}
    return Cause(f"scene {scene.name}, frame {number}, {time:.2f} s", record)


def load_cause(loads: Loads) -> Cause:
    """The one push of a load case."""
    (pushed,) = loads.every(Pushed)
    place, force = 1e3 * pushed.point[0], pushed.force[0]
    newton = float(np.linalg.norm(force))
    direction, radius = force / newton, 1e3 * float(pushed.footprint[0])
    record = {
        "kind": "load",
        "place_mm": _rounded(place),
        "direction": _rounded(direction),
        "force_n": round(newton, 6),
        "radius_mm": round(radius, 6),
    }
    x, y, z = (f"{value + 0.0:.1f}" for value in np.round(place, 1))
    right, anterior, superior = (f"{value + 0.0:.2f}" for value in np.round(direction, 2))
    words = f"a load of {newton:g} N at {x}, {y}, {z} mm towards {right}, {anterior}, {superior} (RAS)"
    return Cause(words, record)


def file_cause(path: Path) -> Cause:
    """A displacement that a file holds."""
    return Cause(f"displacement of {path.name}", {"kind": "file", "file": path.name})


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 6) + 0.0 for value in values]
