"""Observations in CSV files, in millimetres and RAS, with a header that names the columns."""

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.outside_files import to_path, wrap_errors

from .observation import Observation

# Column names: position, motion, standard deviation.
PLACE, MOTION, SIGMA = ("x", "y", "z"), ("dx", "dy", "dz"), "sigma"
NAME_COLUMNS = ("label", "name", "id")
"""Columns with the name of a point, which are ignored."""
MAX_ROWS = 1_000_000  # Maximum number of rows of a list of points.
MAX_LINE_LENGTH = 1000  # Maximum number of characters of a line.
MAX_VALUE = 1e9  # Largest absolute value of a number.


def read_observation(path: str | Path, tips: str | Path | None = None) -> Observation:
    """Read `x,y,z,dx,dy,dz[,sigma]`, points in the scan and their motions, or `x,y,z[,sigma]`, a cloud of the surface.

    `tips` is a file with `x,y,z`: positions of tool tips that touch the cortex. Files are in millimetres, RAS.

    Raises
    ------
    InputError
        A file is missing or not such a table; columns are missing, unknown or duplicated; there are no rows; cells are
        not finite numbers or too large.
    """
    columns = read_columns(path, {(*PLACE, *MOTION), (*PLACE, *MOTION, SIGMA), PLACE, (*PLACE, SIGMA)})
    touched = np.zeros((0, 3)) if tips is None else _to_points(read_columns(tips, {PLACE}), PLACE)
    at = _to_points(columns, PLACE)
    sigma = 1e-3 * columns[SIGMA] if SIGMA in columns else None
    if "dx" in columns:
        return Observation(at + _to_points(columns, MOTION), at, sigma, touched)
    return Observation(at, None, sigma, touched)


def _to_points(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """Convert three columns in mm to points (n, 3) in m."""
    return 1e-3 * np.column_stack([columns[name] for name in names])


def read_columns(
    path: str | Path,
    allowed_headers: set[tuple[str, ...]],
    optional_columns: tuple[str, ...] = (),
    is_blank: Callable[[Mapping[str, str]], bool] | None = None,
) -> dict[str, np.ndarray]:
    """Read the columns of a table by name; the header must be allowed. Cells of `optional_columns` may be empty (NaN).

    If `is_blank` is given, further columns are allowed. It receives the cells of a row by column name; if it returns
    True, the row's `optional_columns` are NaN.

    Raises
    ------
    InputError
        See `read_observation`.
    """
    path = to_path(path)
    known = " or ".join(",".join(names) for names in sorted(allowed_headers))
    remedy = f"Give a CSV file with the header {known}."
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}. {remedy}")
    with wrap_errors(path, "a table of points", remedy):
        text = path.read_text(encoding="utf-8-sig")
    lines = text.splitlines()
    if len(lines) > MAX_ROWS or any(len(line) > MAX_LINE_LENGTH for line in lines):
        raise InputError(f"{path}: has more than {MAX_ROWS:,} rows, or longer ones than a list of points has.")
    reader = csv.reader(lines)
    rows = [(reader.line_num, row) for row in reader if row]
    if not rows:
        raise InputError(f"{path}: is empty: give a table with the header {known}.")
    first = rows.pop(0)[1]
    header = tuple(cell.strip().lower() for cell in first)
    wanted = (
        set(header).difference(NAME_COLUMNS) if is_blank is None else set().union(*allowed_headers).intersection(header)
    )
    if wanted not in map(set, allowed_headers) or len(set(header)) < len(header):
        raise InputError(
            f"{path}: its first line is {','.join(first)[:80]!r}: give the header {known}, with commas between."
        )
    if not rows:
        raise InputError(f"{path}: has a header and no rows: give a row for each point.")
    names = [name for name in header if name in wanted]
    values = np.empty((len(rows), len(names)))
    for value, (number, row) in zip(values, rows, strict=True):
        try:
            cells = dict(zip(header, row, strict=True))
            gone = is_blank is not None and is_blank(cells)
            value[:] = [
                np.nan if name in optional_columns and (gone or not cells[name].strip()) else float(cells[name])
                for name in names
            ]
        except ValueError as error:
            raise InputError(
                f"{path}: row {number} is {','.join(row)[:80]!r}, not {len(header)} numbers: mend or remove it."
            ) from error
        given = [name not in optional_columns or (not gone and bool(cells[name].strip())) for name in names]
        if not (np.abs(value[given]) < MAX_VALUE).all():
            raise InputError(
                f"{path}: row {number} has a number that is not finite, or above {MAX_VALUE:g}: remove it."
            )
    return dict(zip(names, values.T, strict=True))
