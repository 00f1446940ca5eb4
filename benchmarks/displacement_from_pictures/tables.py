"""What was found, as tables in Markdown and as numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from experiment import LEARNING, Row, Sets
from frames import Frames


def counts(sets: Sets) -> dict[str, dict[str, object]]:
    """How many of what is in each set, and how far tumours went [mm]."""
    return {name: _counts(frames) for name, frames in {"training": sets.training, **sets.tests}.items()}


def _counts(frames: Frames) -> dict[str, object]:
    moved = np.linalg.norm(frames.label, axis=1)
    return {
        "episodes": len(frames.episodes), "frames": len(frames), "bodies": len(np.unique(frames.body)),
        "families": sorted(np.unique(frames.family).tolist()),
        "moved_mm": [float(each) for each in np.percentile(moved, [50, 95, 100])],
    }  # fmt: skip


def described(sets: Sets) -> str:
    """The sets as a table."""
    lines = [
        "| frames | episodes | frames | bodies | moved: median, p95, most [mm] | families |",
        "|---|---|---|---|---|---|",
    ]
    for name, said in counts(sets).items():
        moved = ", ".join(f"{each:.2f}" for each in said["moved_mm"])
        numbers = " | ".join(str(said[each]) for each in ("episodes", "frames", "bodies"))
        lines.append(f"| {name} | {numbers} | {moved} | {', '.join(said['families'])} |")
    return "\n".join(lines)


def table(sets: Sets, rows: Sequence[Row]) -> str:
    """Errors with all training episodes; a block for each set."""
    whole = len(sets.training.episodes)
    lines = [
        "| tested on | answered by | given | median [95 % interval] mm | p95 [95 % interval] mm | medians of bodies |",
        "|---|---|---|---|---|---|",
    ]
    for test in sets.tests:
        lines += [
            f"| {row.test} | {row.way} | {row.given} | {row.errors.median} | {row.errors.p95} "
            f"| {row.errors.bodies[0]:.3f} - {row.errors.bodies[1]:.3f} |"
            for row in rows
            if row.test == test and row.episodes == whole
        ]
    return "\n".join(lines)


def curve(sets: Sets, rows: Sequence[Row]) -> str:
    """Median errors by the number of training episodes."""
    sizes = sorted({row.episodes for row in rows})
    lines = [
        "Median [95 % interval] mm by training episodes", "",
        "| tested on | answered by | given | " + " | ".join(map(str, sizes)) + " |",
        "|---|---|---|" + "---|" * len(sizes),
    ]  # fmt: skip
    for test in sets.tests:
        for way, inputs in LEARNING:
            key = test, way, inputs.name
            by_size = {row.episodes: row.errors.median for row in rows if (row.test, row.way, row.given) == key}
            lines.append(f"| {' | '.join(key)} | " + " | ".join(str(by_size[size]) for size in sizes) + " |")
    return "\n".join(lines)
