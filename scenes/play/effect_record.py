"""Recorded cost and influence of a scene's effects, stored next to the anatomy."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec

from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import parse_json, wrap_errors

FORMAT = "sulcus effects 1"  # Name and version of the file format.
SUFFIX = ".effects.json"  # Ending of the file, next to the anatomy.
Figure = Annotated[float, msgspec.Meta(gt=-1e7, lt=1e7)]  # Number in a file [ms, mm].
REMEDY = "Delete it, and measure again by `sulcus effects --out`."  # Remedy for a file that cannot be read.


@dataclass(frozen=True)
class EffectRecord:
    """Measured effects of one scene on one anatomy, from `frames` solved frames.

    `mark`: fingerprint of the scene, see `compute_scene_mark`; `day`: ISO 8601 date; `machine`: description.
    `effects`, by class name: FEM time per frame [ms] and tumour motion [mm] that the effect adds. The key "all" has the
    values of the full scene. Both are None if the scene cannot be solved without the effect; `refused` has the reason.
    `unphysical`: number of frames with inverted or overstrained tetrahedra, summed over all runs.
    """

    scene: str
    mark: str
    day: str
    machine: str
    frames: Annotated[int, msgspec.Meta(ge=1, lt=10**7)]
    effects: Mapping[str, tuple[Figure | None, Figure | None]]
    unphysical: Annotated[int, msgspec.Meta(ge=0, lt=10**7)] = 0
    refused: Mapping[str, str] = field(default_factory=dict)


def format_unphysical(count: int) -> str:
    """Format the number of unphysical frames as a clause; return an empty string for 0."""
    frames = f"{count} frame has" if count == 1 else f"{count} frames have"
    return f"{frames} inverted or overstrained tetrahedra" if count else ""


def read_effect_records(path: Path) -> dict[str, EffectRecord]:
    """Read the records of a file, by scene name; return an empty dict if the file does not exist.

    Raises
    ------
    InputError
        The file is invalid or not readable.
    """
    if not path.is_file():
        return {}
    with wrap_errors(path, "costs of effects", REMEDY):
        parse_json(path, FORMAT, REMEDY)
        stored = msgspec.json.decode(path.read_text(encoding="utf-8-sig"))  # unlike `json`, rejects NaN
        rows = msgspec.convert(stored["scenes"], list[EffectRecord])
        if any((cost is None) != (motion is None) for row in rows for cost, motion in row.effects.values()):
            raise InputError(f"an effect has one figure of two. {REMEDY}")
        return {row.scene: row for row in rows}


def write_effect_record(path: Path, record: EffectRecord) -> None:
    """Add the record of a scene to a file; a former record of the same scene is replaced."""
    rows = (read_effect_records(path) | {record.scene: record}).values()
    with write_atomically(path, ".json") as unfinished:
        stored = {"format": FORMAT, "units": ["ms", "mm"], "scenes": [asdict(row) for row in rows]}
        unfinished.write_text(json.dumps(stored, indent=1) + "\n")
