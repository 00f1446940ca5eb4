"""Recorded cost and influence of a scene's effects, stored next to the anatomy."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import read_as

FORMAT = "sulcus effects 1"  # Name and version of the file format.
SUFFIX = ".effects.json"  # Ending of the file, next to the anatomy.
REMEDY = "Delete it, and measure again by `sulcus effects --out`."  # Remedy for a file that cannot be read.


@dataclass(frozen=True)
class EffectRecord:
    """Measured effects of one scene on one anatomy, of which a number of `frames` was solved.

    `mark`: fingerprint of the scene, see `scenes.script.uncertainty.mark_of`; `day`: ISO 8601; `machine` in words.
    `effects`, by class name: FEM time per frame that an effect adds [ms], and how far it moves the tumour [mm]; None:
    not solvable without it. `all`: time and motion of the whole scene.
    """

    scene: str
    mark: str
    day: str
    machine: str
    frames: int
    effects: Mapping[str, tuple[float | None, float | None]]


def read_effect_records(path: Path) -> dict[str, EffectRecord]:
    """Read the records of a file, by scene; none where there is no file.

    Raises
    ------
    InputError
        A file that cannot be read as such.
    """
    if not path.is_file():
        return {}
    with read_as(path, "costs of effects", REMEDY):
        stored = json.loads(path.read_text(encoding="utf-8-sig"))
        rows = [EffectRecord(**row) for row in stored["scenes"]]
        figures = [one for row in rows for pair in row.effects.values() for one in pair if one is not None]
        if stored["format"] != FORMAT or not np.isfinite(figures).all():
            raise InputError(f"its format is not {FORMAT!r}, or a figure is not finite. {REMEDY}")
        return {row.scene: row for row in rows}


def write_effect_record(path: Path, found: EffectRecord) -> None:
    """Add a scene to a file, or replace it."""
    rows = (read_effect_records(path) | {found.scene: found}).values()
    with write_atomically(path, ".json") as unfinished:
        stored = {"format": FORMAT, "units": ["ms", "mm"], "scenes": [asdict(row) for row in rows]}
        unfinished.write_text(json.dumps(stored, indent=1) + "\n")
