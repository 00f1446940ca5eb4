"""Surfaces of a head from FIF, the format of MNE's boundary elements: tags with a header of four whole numbers each."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..runtime.outside_files import read_as

FRAME, POINTS, TRIANGLES = 3112, 3105, 3106
"""Kinds of tags: a surface's frame of coordinates, its vertices and its triangles."""
MRI = 5
FLOATS, INTEGERS = 0x40000004, 0x40000003
"""Types of data: dense matrices, row by row, with their sizes behind them, the last axis first."""


def read_surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The one closed surface in a FIF file: vertices (n, 3) [m, RAS of the MRI], triangles (m, 3).

    Raises
    ------
    InputError
        A file that is not FIF, is cut off, or does not hold one surface in the MRI's frame.
    """
    with read_as(path, "a surface in FIF", "Install the package that it comes from anew."):
        tags = _tags(path.read_bytes())
        for kind in (FRAME, POINTS, TRIANGLES):
            if len(tags.get(kind, ())) != 1:
                raise InputError("does not hold one surface in FIF. Install the package that it comes from anew.")
        if struct.unpack(">i", tags[FRAME][0][1]) != (MRI,):
            raise InputError("its surface is not in the MRI's frame. Install the package that it comes from anew.")
        points = _matrix(*tags[POINTS][0], FLOATS, ">f4").astype(np.float64)
        triangles = _matrix(*tags[TRIANGLES][0], INTEGERS, ">i4").astype(np.int64) - 1
        if not np.isfinite(points).all() or triangles.min() < 0 or triangles.max() >= len(points):
            raise InputError("is damaged: its triangles name no vertices. Install the package that it comes from anew.")
        return points, triangles


def _tags(raw: bytes) -> dict[int, list[tuple[int, bytes]]]:
    """Type and data of every tag, by kind; where the next one begins is followed forwards only."""
    tags: dict[int, list[tuple[int, bytes]]] = {}
    at = 0
    while at >= 0:
        kind, of, size, following = struct.unpack_from(">iiii", raw, at)
        data = raw[at + 16 : at + 16 + size]
        if size < 0 or len(data) != size:
            raise EOFError
        tags.setdefault(kind, []).append((of, data))
        end = at + 16 + size
        if following == 0 and end == len(raw):
            break
        at = end if following == 0 else following
        if 0 <= at < end:
            raise ValueError("its tags run in a circle")
    return tags


def _matrix(of: int, data: bytes, wanted: int, each: str) -> np.ndarray:
    columns, rows, axes = struct.unpack(">iii", data[-12:])
    if of != wanted or axes != 2 or columns != 3:
        raise ValueError("its tables are not of three columns")
    return np.frombuffer(data[:-12], each).reshape(rows, columns)
