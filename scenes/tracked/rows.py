"""A table of an overlay's pictures: state, the tumour's place and its error, and what it took."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from sim.runtime.atomic_files import written_whole

from .run import Shown
from .truth import Off

COLUMNS = (
    "time_s", "state", "tumour_x_mm", "tumour_y_mm", "tumour_z_mm", "moved_mm", "motion_off_mm", "within_mm",
    "tracking_mm", "camera_mm", "registration_mm", "tool_mm", "model_mm", "shutter_mm", "ms", "latency_ms", "words",
    "outline_px", "overlap", "middle_off_mm", "worst_off_mm", "space",
)  # fmt: skip


def write_rows(path: Path, shown: Sequence[Shown], errors: Sequence[Off | None]) -> None:
    """Write a row for each picture, which appear all or not at all; what is not known is blank.

    The place is that of the tumour's middle in the scan, RAS. `within_mm` holds with 95 %, across the line of sight.
    Four columns hold it against the truth, if that is given; the last one names the space.
    """
    with written_whole(path, ".csv") as partial, partial.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows(_row(each, error) for each, error in zip(shown, errors, strict=True))


def _row(shown: Shown, error: Off | None) -> list[str]:
    known = shown.known
    placed = known.camera is not None
    lengths: list[float | None] = [*shown.middle, known.motion.moved if known.motion.known else None]
    lengths.append(known.motion.error if known.motion.known else None)
    lengths += [
        known.band,
        *(known.parts.get(name) for name in ("tracking", "camera", "registration", "tool", "model", "shutter")),
    ]
    cells = [_number(None if value is None or not placed else 1e3 * value) for value in lengths]
    late = None if shown.latency is None else 1e3 * shown.latency
    against = (None,) * 4 if error is None else (error.outline, error.overlap, 1e3 * error.middle, 1e3 * error.worst)
    return [
        f"{known.time:.6f}", known.state.name.lower(), *cells, f"{1e3 * shown.seconds:.1f}", _number(late, 1),
        known.words, *(_number(value, 3) for value in against), "RAS",
    ]  # fmt: skip


def _number(value: float | None, digits: int = 4) -> str:
    return "" if value is None else f"{value:.{digits}f}"
