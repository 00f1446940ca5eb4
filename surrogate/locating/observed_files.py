"""Observations in CSV files: millimetres, RAS, a header that says what each column is."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.outside_files import path_of, read_as

from .observation import Observation

PLACE, MOTION, SIGMA = ("x", "y", "z"), ("dx", "dy", "dz"), "sigma"
# Rows and characters of a line, beyond which a file is no list of points.
MOST_ROWS, LONGEST_LINE = 1_000_000, 1000


def read_observation(path: str | Path, tips: str | Path | None = None) -> Observation:
    """Read `x,y,z,dx,dy,dz[,sigma]`, points in the scan and how they moved, or `x,y,z[,sigma]`, a cloud of the surface.

    `tips` is a file of `x,y,z`: where tips of tools touch the surface. All in millimetres, RAS.

    Raises
    ------
    InputError
        A file that is missing or no such table, columns that are missing, unknown or named twice, cells that are no
        finite numbers.
    """
    columns = read_columns(path, {(*PLACE, *MOTION), (*PLACE, *MOTION, SIGMA), PLACE, (*PLACE, SIGMA)})
    touched = np.zeros((0, 3)) if tips is None else _points(read_columns(tips, {PLACE}), PLACE)
    at = _points(columns, PLACE)
    sigma = 1e-3 * columns[SIGMA] if SIGMA in columns else None
    if "dx" in columns:
        return Observation(at + _points(columns, MOTION), at, sigma, touched)
    return Observation(at, None, sigma, touched)


def _points(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """Columns [mm] as points (n, 3) [m]."""
    return 1e-3 * np.column_stack([columns[name] for name in names])


def read_columns(
    path: str | Path, allowed: set[tuple[str, ...]], empty: tuple[str, ...] = (), others: bool = False
) -> dict[str, np.ndarray]:
    """Columns of a table by name, whose header is one of those allowed; in some columns cells may be `empty`: NaN.

    With `others`, further columns are passed over, whatever they hold.

    Raises
    ------
    InputError
        As `read_observation`.
    """
    path = path_of(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    known = " or ".join(",".join(names) for names in sorted(allowed))
    with read_as(path, "a table of points", f"Give a CSV file with the header {known}."):
        text = path.read_text(encoding="utf-8-sig")
    lines = text.splitlines()
    if len(lines) > MOST_ROWS or any(len(line) > LONGEST_LINE for line in lines):
        raise InputError(f"{path}: has more than {MOST_ROWS:,} rows, or longer ones than a list of points has.")
    rows = [row for row in csv.reader(lines) if row]
    if not rows:
        raise InputError(f"{path}: is empty: give a table with the header {known}.")
    header = tuple(cell.strip().lower() for cell in rows[0])
    wanted = set().union(*allowed).intersection(header) if others else set(header)
    if wanted not in map(set, allowed) or len(set(header)) < len(header):
        raise InputError(
            f"{path}: its first line is {','.join(rows[0])[:80]!r}: give the header {known}, with commas between."
        )
    names = [name for name in header if name in wanted]
    values = np.empty((len(rows) - 1, len(names)))
    for number, row in enumerate(rows[1:], start=2):
        try:
            cells = [cell for name, cell in zip(header, row, strict=True) if name in wanted]
            values[number - 2] = [
                float(cell) if cell.strip() or name not in empty else np.nan
                for name, cell in zip(names, cells, strict=True)
            ]
        except ValueError as error:
            raise InputError(
                f"{path}: row {number} is {','.join(row)[:80]!r}, not {len(header)} numbers: mend or remove it."
            ) from error
        if not np.isfinite(values[number - 2][[bool(cell.strip()) for cell in cells]]).all():
            raise InputError(f"{path}: row {number} has a number that is not finite: remove it.")
    return dict(zip(names, values.T, strict=True))
