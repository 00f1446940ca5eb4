"""Tools of several frames in one CSV file: millimetres, RAS and newtons."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim.errors import InputError

from ..locating.observed_files import PLACE, SIGMA, read_columns
from .frame import RADIUS, Tool

FRAME, WIDE, FORCE = "frame", "radius", "force"
# What may follow the place, and which columns cells may be empty of.
ALLOWED = {
    (FRAME, *PLACE, *more) for more in ((), (WIDE,), (FORCE,), (WIDE, FORCE), (FORCE, SIGMA), (WIDE, FORCE, SIGMA))
}
EMPTY = (WIDE, FORCE, SIGMA)


def read_tools(path: str | Path, frames: int) -> tuple[tuple[Tool, ...], ...]:
    """Read `frame,x,y,z[,radius][,force[,sigma]]`: the tools of each of so many frames, which count from 1.

    Cells of radius, force and sigma may be empty: the usual radius, and a force that nobody read.

    Raises
    ------
    InputError
        A file that is missing or no such table; a frame that there is not.
    """
    columns = read_columns(path, ALLOWED, EMPTY)
    found: list[list[Tool]] = [[] for _ in range(frames)]
    for row, number in enumerate(columns[FRAME]):
        if number not in range(1, frames + 1):
            raise InputError(
                f"{path}: row {row + 2} is of frame {number:g}, but there are {frames}: they count from 1."
            )
        radius, force, sigma = (
            None if name not in columns or np.isnan(columns[name][row]) else float(columns[name][row]) for name in EMPTY
        )
        x, y, z = (1e-3 * float(columns[name][row]) for name in PLACE)
        found[int(number) - 1].append(Tool((x, y, z), RADIUS if radius is None else 1e-3 * radius, force, sigma))
    return tuple(map(tuple, found))
