"""Writers of displacement fields and segmentations as NRRD."""

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from sim.bodies.voxels import LPS
from sim.fields.grid import Grid, build_grid_around
from sim.fields.grid_interpolation import interpolate_in_tetrahedra

TYPES = {"f4": "float", "u1": "unsigned char"}  # Names of data types in NRRD.
LEVEL = 1  # Lowest compression level: higher levels hardly reduce floats.
DIGITS = 4
"""Number of decimals of displacements [mm]; further decimals have no meaning and double the file size."""
TUMOUR, SHELL = 1, 2
"""Labels of the segments: the tumour, and tissue that may be tumour."""
COLOURS = {TUMOUR: (0.20, 0.94, 0.42), SHELL: (0.95, 0.75, 0.20)}  # Colours (RGB, 0 to 1) of the segments.
VOXEL = 0.5e-3  # Edge of a voxel [m].
MARGIN = 2e-3  # Margin round the segments [m].
MASS = (  # SNOMED CT's terms for a mass, as Slicer writes them.
    "Segmentation category and type - 3D Slicer General Anatomy list~SCT^49755003^Morphologically Altered Structure"
    "~SCT^4147007^Mass~^^~Anatomic codes - DICOM master list~^^~^^"
)


def write_field_nrrd(path: Path, grid: Grid, field: np.ndarray, direction: str) -> None:
    """Write a displacement field (3, I, J, K) [m, RAS]; `direction` is "modeling" or "resampling"."""
    header = {"kinds": "vector domain domain domain", **_build_space_header(grid, "none {axes}")}
    write_nrrd(path, _to_millimetres(field), header, _build_displacement_header(direction))


def write_field_sequence(path: Path, grid: Grid, fields: Sequence[np.ndarray], times: Sequence[float]) -> None:
    """Write forward displacement fields (3, I, J, K) [m, RAS], one for each time [s], as a sequence of 3D Slicer."""
    vectors = np.stack([_to_millimetres(field) for field in fields], axis=-1)
    header = {
        "kinds": "vector domain domain domain list",
        "labels": '"" "" "" "" "time"',
        "units": '"" "" "" "" "s"',
        **_build_space_header(grid, "none {axes} none"),
    }
    index = {"axis 3 index type": "numeric", "axis 3 index values": " ".join(f"{time:.6g}" for time in times)}
    write_nrrd(path, vectors, header, {**index, **_build_displacement_header("modeling")})


def write_labels_nrrd(path: Path, grid: Grid, labels: np.ndarray, metadata: Mapping[str, str]) -> None:
    """Write labels (I, J, K) uint8 on a grid; `metadata` are the key-value pairs of the NRRD file."""
    header = {"kinds": "domain domain domain", **_build_space_header(grid, "{axes}")}
    write_nrrd(path, labels, header, metadata)


def write_nrrd(path: Path, values: np.ndarray, header: Mapping[str, str], metadata: Mapping[str, str]) -> None:
    """Write an array as NRRD with header fields and key-value pairs; the first axis varies fastest in the file."""
    lines = [
        "NRRD0005",
        f"type: {TYPES[values.dtype.str[1:]]}",
        f"dimension: {values.ndim}",
        "space: left-posterior-superior",
        f"sizes: {' '.join(map(str, values.shape))}",
        *(f"{name}: {value}" for name, value in header.items()),
        "endian: little",
        "encoding: gzip",
        *(f"{name}:={value}" for name, value in metadata.items()),
    ]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n\n").encode("ascii"))
        with gzip.GzipFile("", "wb", LEVEL, file, mtime=0) as packed:
            packed.write(values.tobytes(order="F"))


def _to_millimetres(field: np.ndarray) -> np.ndarray:
    return np.round(1e3 * field * LPS[:, None, None, None], DIGITS).astype("<f4")


def _build_space_header(grid: Grid, axes: str) -> dict[str, str]:
    edges = np.diag(1e3 * grid.spacing * LPS)
    directions = " ".join(_format_vector(edge) for edge in edges)
    frame = {"measurement frame": "(1,0,0) (0,1,0) (0,0,1)"} if "none" in axes else {}
    return {
        "space directions": axes.format(axes=directions),
        "space origin": _format_vector(1e3 * grid.origin * LPS),
        "space units": '"mm" "mm" "mm"',
        **frame,
    }


def _format_vector(values: np.ndarray) -> str:
    return f"({','.join(f'{value + 0.0:.12g}' for value in values)})"


def _build_displacement_header(direction: str) -> dict[str, str]:
    # NIfTI's intent code, by which Slicer and ITK distinguish a transform from other vectors.
    return {"displacement field type": direction, "intent_code": "1006"}


def write_segmentation(path: Path, nodes: np.ndarray, tets: np.ndarray, bound: float | None) -> None:
    """Write a tumour with tetrahedra (T, 4) and nodes (V, 3) [m, RAS], and, if a bound [m] is given, a shell.

    The shell is all tissue outside the tumour within this bound. It bounds the position of the surface, not its size.
    """
    grid = build_grid_around(nodes[np.unique(tets)], VOXEL, (bound or 0.0) + MARGIN)
    inside = interpolate_in_tetrahedra(grid, nodes, tets, np.zeros_like(nodes))[1]
    labels = np.where(inside, TUMOUR, 0).astype(np.uint8)
    names = {TUMOUR: "tumour"}
    if bound is not None:
        away = np.asarray(ndimage.distance_transform_edt(~inside))
        near = VOXEL * away <= bound
        labels[near & ~inside] = SHELL
        names[SHELL] = f"may be tumour: within {1e3 * bound:.1f} mm (95 %)"
    extent = " ".join(f"0 {side - 1}" for side in grid.shape)
    pairs = {
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|",
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    for number, (label, name) in enumerate(names.items()):
        pairs |= {
            f"Segment{number}_ID": f"Segment_{label}",
            f"Segment{number}_Name": name,
            f"Segment{number}_NameAutoGenerated": "0",
            f"Segment{number}_Color": " ".join(f"{value:g}" for value in COLOURS[label]),
            f"Segment{number}_ColorAutoGenerated": "0",
            f"Segment{number}_LabelValue": str(label),
            f"Segment{number}_Layer": "0",
            f"Segment{number}_Extent": extent,
            f"Segment{number}_Tags": f"Segmentation.Status:completed|TerminologyEntry:{MASS}|",
        }
    write_labels_nrrd(path, grid, labels, pairs)
