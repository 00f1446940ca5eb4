"""Surfaces of a head from FIF, the format of MNE's boundary elements: tags with headers of four whole numbers."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..runtime.outside_files import read_as

FRAME, POINTS, TRIANGLES = 3112, 3105, 3106
"""Kinds of tags: a surface's frame of coordinates, its vertices and its triangles."""
MRI = 5
FLOATS, INTEGERS = (0x40000004, ">f4"), (0x40000003, ">i4")
"""Types of dense matrices: row by row, and behind them columns, rows and the number of axes."""


def read_surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the one surface in a FIF file: vertices (n, 3) [m, RAS of the MRI], triangles (m, 3).

    Raises
    ------
    InputError
        A file that is not FIF, is cut off or damaged, or does not hold one surface in the MRI's frame.
    """
    with read_as(path, "one surface in FIF, in the frame of the MRI", "Install the package that it belongs to anew."):
        tags = _tags(path.read_bytes())
        ((_, frame),), (points,), (triangles,) = (tags[kind] for kind in (FRAME, POINTS, TRIANGLES))
        vertices = _matrix(*points, FLOATS).astype(np.float64)
        faces = _matrix(*triangles, INTEGERS).astype(np.int64) - 1
        if struct.unpack(">i", frame) != (MRI,) or not np.isfinite(vertices).all():
            raise ValueError(frame)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("triangles of vertices that are not there")
        return vertices, faces


def _tags(raw: bytes) -> dict[int, list[tuple[int, bytes]]]:
    """Type and data of every tag, by kind. A header says where the next one is: 0 behind this one, -1 nowhere."""
    tags: dict[int, list[tuple[int, bytes]]] = {}
    at = 0
    while 0 <= at < len(raw):
        kind, of, size, following = struct.unpack_from(">iiii", raw, at)
        end = at + 16 + size
        if end > len(raw):
            raise EOFError
        if size < 0 or 0 < following < end:
            raise ValueError("tags in a circle")
        tags.setdefault(kind, []).append((of, raw[at + 16 : end]))
        at = following or end
    return tags


def _matrix(of: int, data: bytes, wanted: tuple[int, str]) -> np.ndarray:
    columns, rows, axes = struct.unpack(">iii", data[-12:])
    if of != wanted[0] or (columns, axes) != (3, 2):
        raise ValueError("no table of three columns")
    return np.frombuffer(data[:-12], wanted[1]).reshape(rows, columns)
