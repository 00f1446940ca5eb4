"""NRRD as 3D Slicer and ITK read it: millimetres, LPS."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sim.bodies.voxels import LPS
from sim.fields.grid import Grid

TYPES = {"f4": "float", "u1": "unsigned char"}
# Of the least effort: floats hardly get smaller by more.
LEVEL = 1
DIGITS = 4
"""Of displacements in millimetres: what lies behind has no meaning, and takes half of a file."""


def write_field_nrrd(path: Path, grid: Grid, field: np.ndarray, direction: str) -> None:
    """Write a displacement field (3, I, J, K) [m, RAS]; its direction is `modeling` or `resampling`."""
    header = {"kinds": "vector domain domain domain", **_placed(grid, "none {axes}")}
    write_nrrd(path, _millimetres(field), header, _displacement(direction))


def write_field_sequence(path: Path, grid: Grid, fields: Sequence[np.ndarray], times: Sequence[float]) -> None:
    """Write modelling fields (3, I, J, K) [m, RAS], one for each time [s], as one sequence."""
    vectors = np.stack([_millimetres(field) for field in fields], axis=-1)
    header = {
        "kinds": "vector domain domain domain list",
        "labels": '"" "" "" "" "time"',
        "units": '"" "" "" "" "s"',
        **_placed(grid, "none {axes} none"),
    }
    index = {"axis 3 index type": "numeric", "axis 3 index values": " ".join(f"{time:.6g}" for time in times)}
    write_nrrd(path, vectors, header, {**index, **_displacement("modeling")})


def write_labels_nrrd(path: Path, grid: Grid, labels: np.ndarray, pairs: Mapping[str, str]) -> None:
    """Write labels (I, J, K) uint8 on a grid, with pairs of names and values behind the header."""
    header = {"kinds": "domain domain domain", **_placed(grid, "{axes}")}
    write_nrrd(path, labels, header, pairs)


def write_nrrd(path: Path, values: np.ndarray, header: Mapping[str, str], pairs: Mapping[str, str]) -> None:
    """Write an array, whose first axis runs fastest in the file, under header fields and pairs of names and values."""
    lines = [
        "NRRD0005",
        f"type: {TYPES[values.dtype.str[1:]]}",
        f"dimension: {values.ndim}",
        "space: left-posterior-superior",
        f"sizes: {' '.join(map(str, values.shape))}",
        *(f"{name}: {value}" for name, value in header.items()),
        "endian: little",
        "encoding: gzip",
        *(f"{name}:={value}" for name, value in pairs.items()),
    ]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n\n").encode("ascii"))
        with gzip.GzipFile("", "wb", LEVEL, file, mtime=0) as packed:
            packed.write(values.tobytes(order="F"))


def _millimetres(field: np.ndarray) -> np.ndarray:
    return np.round(1e3 * field * LPS[:, None, None, None], DIGITS).astype("<f4")


def _placed(grid: Grid, axes: str) -> dict[str, str]:
    edges = np.diag(1e3 * grid.spacing * LPS)
    directions = " ".join(_vector(edge) for edge in edges)
    frame = {"measurement frame": "(1,0,0) (0,1,0) (0,0,1)"} if "none" in axes else {}
    return {
        "space directions": axes.format(axes=directions),
        "space origin": _vector(1e3 * grid.origin * LPS),
        "space units": '"mm" "mm" "mm"',
        **frame,
    }


def _vector(values: np.ndarray) -> str:
    return f"({','.join(f'{value + 0.0:.12g}' for value in values)})"


def _displacement(direction: str) -> dict[str, str]:
    # The number of NIfTI's intent: by it Slicer and ITK tell a transform from other vectors.
    return {"displacement field type": direction, "intent_code": "1006"}
