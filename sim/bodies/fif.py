"""Reader for head surfaces in FIF, the format of MNE's boundary elements: tags with headers of four integers."""

import struct
from pathlib import Path

import numpy as np

from ..runtime.outside_files import read_as

FRAME, POINTS, TRIANGLES = 3112, 3105, 3106
"""Tag kinds: coordinate system, vertices and triangles of a surface."""
MRI = 5  # FIF code of the MRI coordinate system
# Dense matrices: data row by row, then columns, rows and number of axes.
FLOATS = 0x40000004, ">f4"  # type code and NumPy dtype of float matrices
INTEGERS = 0x40000003, ">i4"  # type code and NumPy dtype of integer matrices


def read_surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface in a FIF file: vertices (n, 3) [m, RAS of the MRI], triangles (m, 3).

    Raises
    ------
    InputError
        A file that is not FIF, is truncated or damaged, or does not contain one surface in MRI coordinates.
    """
    with read_as(path, "one surface in FIF, in the frame of the MRI", "Reinstall its package."):
        tags = _parse_tags(path.read_bytes())
        ((_, frame),), (points,), (triangles,) = (tags[kind] for kind in (FRAME, POINTS, TRIANGLES))
        vertices = _parse_matrix(*points, FLOATS).astype(np.float64)
        faces = _parse_matrix(*triangles, INTEGERS).astype(np.int64) - 1
        if struct.unpack(">i", frame) != (MRI,) or not np.isfinite(vertices).all():
            raise ValueError(frame)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("triangles of vertices that are not there")
        return vertices, faces


def _parse_tags(raw: bytes) -> dict[int, list[tuple[int, bytes]]]:
    """Return type and data of all tags by kind. A header gives the next position: 0 for adjacent, -1 for the end."""
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


def _parse_matrix(of: int, data: bytes, wanted: tuple[int, str]) -> np.ndarray:
    columns, rows, axes = struct.unpack(">iii", data[-12:])
    if of != wanted[0] or (columns, axes) != (3, 2):
        raise ValueError("no table of three columns")
    return np.frombuffer(data[:-12], wanted[1]).reshape(rows, columns)
