"""What was found, as tables in Markdown, and as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from errors import Errors, Figure
from experiment import LEARNING, TRAINING, Row, Sets
from frames import Frames


def said(sets: Sets, rows: Sequence[Row], **more: object) -> dict[str, Any]:
    """All of it as JSON has it: how many of what is in each set, how far tumours went [mm], and errors [mm]."""
    counted = {name: _counts(frames) for name, frames in {TRAINING: sets.training, **sets.tests}.items()}
    return {**more, "sets": counted, "rows": [asdict(row) for row in rows]}


def _counts(frames: Frames) -> dict[str, Any]:
    moved = np.linalg.norm(frames.label, axis=1)
    return {
        "episodes": len(frames.episodes), "frames": len(frames), "bodies": len(np.unique(frames.body)),
        "families": sorted(np.unique(frames.family).tolist()),
        "moved_mm": [float(each) for each in np.percentile(moved, [50, 95, 100])],
    }  # fmt: skip


def tables(found: Mapping[str, Any]) -> str:
    """Tables of what `said` says."""
    rows = [Row(**{**row, "errors": _errors(row["errors"])}) for row in found["rows"]]
    tests = [name for name in found["sets"] if name != TRAINING]
    whole = [row for row in rows if row.episodes == found["sets"][TRAINING]["episodes"]]
    return "\n\n".join(
        [
            _sets(found["sets"]),
            "Median error [95 % interval] mm:\n\n" + _by_test(tests, whole, lambda errors: str(errors.median)),
            "95th percentile [95 % interval] mm:\n\n" + _by_test(tests, whole, lambda errors: str(errors.p95)),
            "Medians of single bodies, least to greatest, mm:\n\n"
            + _by_test(tests, whole, lambda errors: f"{errors.bodies[0]:.3f} - {errors.bodies[1]:.3f}"),
            "Median error [95 % interval] mm, by training episodes:\n\n" + _curve(tests, rows),
        ]
    )


def _errors(errors: Mapping[str, Any]) -> Errors:
    return Errors(Figure(**errors["median"]), Figure(**errors["p95"]), tuple(errors["bodies"]))


def _grid(head: Sequence[object], lines: Sequence[Sequence[object]]) -> str:
    rule = ["---"] * len(head)
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in (head, rule, *lines))


def _sets(sets: Mapping[str, Mapping[str, Any]]) -> str:
    lines = [
        [name, *(one[key] for key in ("episodes", "frames", "bodies")),
         ", ".join(f"{each:.2f}" for each in one["moved_mm"]), ", ".join(one["families"])]
        for name, one in sets.items()
    ]  # fmt: skip
    return _grid(["", "episodes", "frames", "bodies", "moved: median, p95, most [mm]", "families"], lines)


def _by_test(tests: Sequence[str], rows: Sequence[Row], cell: Callable[[Errors], str]) -> str:
    found = {(row.way, row.given, row.test): cell(row.errors) for row in rows}
    ways = dict.fromkeys((row.way, row.given) for row in rows)
    return _grid(["answered by", "given", *tests], [[*way, *(found[*way, test] for test in tests)] for way in ways])


def _curve(tests: Sequence[str], rows: Sequence[Row]) -> str:
    sizes = sorted({row.episodes for row in rows})
    found = {(row.test, row.way, row.given, row.episodes): row.errors.median for row in rows}
    keys = [(test, way, inputs.name) for test in tests for way, inputs in LEARNING]
    lines = [[*key, *(found.get((*key, size), "") for size in sizes)] for key in keys]
    return _grid(["tested on", "answered by", "given", *sizes], lines)
