"""Recorded cost and influence of a scene's effects, stored next to the anatomy."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import parse_json, read_as

FORMAT = "sulcus effects 1"  # Name and version of the file format.
SUFFIX = ".effects.json"  # Ending of the file, next to the anatomy.
MAX_FIGURE = 1e7  # Upper bound on the size of every number in a file [ms, mm, frames].
REMEDY = "Delete it, and measure again by `sulcus effects --out`."  # Remedy for a file that cannot be read.


@dataclass(frozen=True)
class EffectRecord:
    """Measured effects of one scene on one anatomy, of which a number of `frames` was solved.

    `mark`: fingerprint of the scene, see `scenes.script.uncertainty.mark_of`; `day`: ISO 8601; `machine` in words.
    `effects`, by class name: FEM time per frame that an effect adds [ms], and how far it moves the tumour [mm]; None:
    not solvable without it, `refused` has the reason. `all`: time and motion of the whole scene. `unphysical`: number
    of frames with inverted or overstrained tetrahedra, in the solutions with and without each effect.
    """

    scene: str
    mark: str
    day: str
    machine: str
    frames: int
    effects: Mapping[str, tuple[float | None, float | None]]
    unphysical: int = 0
    refused: Mapping[str, str] = field(default_factory=dict)


def format_unphysical(count: int) -> str:
    """Describe a number of unphysical frames; empty for none."""
    frames = f"{count} frame has" if count == 1 else f"{count} frames have"
    return f"{frames} inverted or overstrained tetrahedra" if count else ""


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
        return {row.scene: row for row in map(_read_row, parse_json(path, FORMAT, REMEDY)["scenes"])}


def _read_row(row: dict[str, Any]) -> EffectRecord:
    scene, mark, day, machine = (row[key] for key in ("scene", "mark", "day", "machine"))
    frames, unphysical, refused = row["frames"], row.get("unphysical", 0), dict(row.get("refused", {}))
    "".join((scene, mark, day, machine, *refused, *refused.values())).encode()  # fails for a value that is not text
    if any(type(count) is not int for count in (frames, unphysical)) or not 1 <= frames < MAX_FIGURE > unphysical >= 0:
        raise InputError(f"frames must be an integer >= 1, unphysical an integer >= 0. {REMEDY}")
    effects = {name: _read_pair(pair) for name, pair in row["effects"].items()}
    return EffectRecord(scene, mark, day, machine, frames, effects, unphysical, refused)


def _read_pair(pair: Any) -> tuple[float | None, float | None]:
    if pair == [None, None]:
        return None, None
    if len(pair) != 2 or not all(type(one) in (int, float) and abs(one) < MAX_FIGURE for one in pair):
        raise InputError(f"a figure is not finite: an effect has two below {MAX_FIGURE:g}, or two nulls. {REMEDY}")
    return float(pair[0]), float(pair[1])


def write_effect_record(path: Path, found: EffectRecord) -> None:
    """Add a scene to a file, or replace it."""
    rows = (read_effect_records(path) | {found.scene: found}).values()
    with write_atomically(path, ".json") as unfinished:
        stored = {"format": FORMAT, "units": ["ms", "mm"], "scenes": [asdict(row) for row in rows]}
        unfinished.write_text(json.dumps(stored, indent=1) + "\n")
