"""Reader for NRRD volumes, with attached or detached data, and for 3D Slicer segmentations (`.seg.nrrd`)."""

import bz2
import gzip
import math
import re
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path, PureWindowsPath
from typing import BinaryIO

import numpy as np

from ..errors import InputError
from ..runtime.file_limits import BZIP2_ALLOWANCE, MAX_INFLATION, MAX_VOXELS
from .voxels import BLOCK, REMEDY, SURPLUS, Segment, Volume, VoxelSpec

SIGNS = {
    "right-anterior-superior": (1.0, 1.0, 1.0),
    "left-anterior-superior": (-1.0, 1.0, 1.0),
    "left-posterior-superior": (-1.0, -1.0, 1.0),
}
"""Sign of each coordinate in the conversion to RAS, for each anatomical space."""
SHORT = {"".join(word[0] for word in space.split("-")): space for space in SIGNS}  # spaces by their initials
METRES = {"mm": 1e-3, "": 1e-3, "m": 1.0, "cm": 1e-2, "um": 1e-6}  # length units [m]
TYPES = {  # NumPy types by NRRD names, without byte order
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}
ENDIAN = {"little": "<", "big": ">"}  # NumPy byte order
MAX_LINE_LENGTH = 2**16  # maximum length of a header line [characters]
MAX_HEADER_LINES = 2**14  # maximum header lines; 100 segments take 1,000
ONE_FILE = "Save it as one file (.nrrd), with its header and voxels together."


def read_nrrd(path: Path, spec: VoxelSpec) -> Volume:
    """Return the volume in an NRRD file or in its detached data file; segment layers have the shape (I, J, K, L).

    An NRRD file gives its unit (default: millimetres) and one affine, so the options `spec` are ignored.

    Raises
    ------
    InputError
        The file has another format, an incomplete header or no anatomical space. The voxels are in several files, in
        another folder, or in an encoding other than raw, gzip or bzip2. There are fewer voxels than declared, or
        too many voxels.
    """
    with path.open("rb") as file:
        fields, keys = _read_header(path, file)
        sizes = [int(size) for size in _get_field(path, fields, "sizes").split()]
        if len(sizes) != int(_get_field(path, fields, "dimension")) or min(sizes, default=0) < 1:
            raise InputError(f"{path}: its sizes do not match its dimension. Save it again.")
        if math.prod(sizes) > MAX_VOXELS:
            raise InputError(
                f"{path}: has {math.prod(sizes):.3g} voxels; the maximum is {MAX_VOXELS:.3g}. Resample it."
            )
        dtype = _parse_dtype(path, fields)
        needed, beside = math.prod(sizes) * dtype.itemsize, _find_data_file(path, fields)
        with nullcontext(file) if beside is None else beside.open("rb") as voxels_file:
            held = _read_voxels(beside or path, voxels_file, fields, needed)
        values = np.frombuffer(held, dtype, math.prod(sizes)).reshape(sizes, order="F")
    values = values.astype(dtype.newbyteorder("="), copy=False)
    affine, across = _parse_affine(path, fields, len(sizes))
    if across:
        values = np.moveaxis(values, across[0], -1)
    return Volume(values, affine, segments=_parse_segments(path, keys, values.shape[3] if across else 1))


def _read_header(path: Path, file: BinaryIO) -> tuple[dict[str, str], dict[str, str]]:
    """Return the fields, by name in lower case, and the custom keys; leave the file position at the voxel data."""
    if not re.fullmatch(rb"(\xef\xbb\xbf)?NRRD000[1-5]\s*", file.readline(MAX_LINE_LENGTH)):
        raise InputError(f"{path}: does not begin with an NRRD header. {REMEDY}")
    fields, keys = {}, {}
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(MAX_LINE_LENGTH)
        if not line and _get_data_file_name(fields):
            return fields, keys
        if not line.endswith(b"\n"):
            break
        text = line.decode("utf-8", "replace").rstrip("\r\n")
        if not text:
            return fields, keys
        if text.startswith("#"):
            continue
        if ":=" in text and not re.match(r"[a-z ]+: ", text):
            key, value = text.split(":=", 1)
            keys[key] = value
        elif ":" in text:
            name, value = text.split(":", 1)
            fields[name.strip().lower()] = value.strip()
    raise InputError(f"{path}: its header has no end. Copy or save it again.")


def _get_data_file_name(fields: Mapping[str, str]) -> str:
    """Return the name of the detached data file, or an empty string if the data is attached."""
    return fields.get("data file", fields.get("datafile", ""))


def _find_data_file(path: Path, fields: Mapping[str, str]) -> Path | None:
    """Return the path of the detached data file, in the same folder; None if the data is attached."""
    name = _get_data_file_name(fields)
    if not name:
        return None
    if name != PureWindowsPath(name).name or name == "..":
        raise InputError(f"{path}: has its voxels in {name!r}, and only a file in the same folder is read. {ONE_FILE}")
    found = path.parent / name
    if not found.is_file():
        raise InputError(f"{path}: has its voxels in {name!r}, and no such file is in the same folder. {ONE_FILE}")
    return found


def _get_field(path: Path, fields: Mapping[str, str], name: str) -> str:
    if name not in fields:
        raise InputError(f"{path}: its header does not state its {name}. Save it again with another program.")
    return fields[name]


def _parse_dtype(path: Path, fields: Mapping[str, str]) -> np.dtype:
    kind = _get_field(path, fields, "type").lower()
    if kind not in TYPES:
        raise InputError(f"{path}: holds values of type {kind!r}, not plain numbers. {REMEDY}")
    if TYPES[kind].endswith("1"):
        return np.dtype(TYPES[kind])
    endian = _get_field(path, fields, "endian").lower()
    if endian not in ENDIAN:
        raise InputError(f"{path}: states its endian as {endian!r}: must be little or big. Save it again.")
    return np.dtype(ENDIAN[endian] + TYPES[kind])


def _read_voxels(path: Path, file: BinaryIO, fields: Mapping[str, str], length: int) -> bytes:
    """Return the decompressed voxel data; memory is allocated only for data that the file can contain."""
    if any(float(fields.get(skip, 0)) for skip in ("byte skip", "byteskip", "line skip", "lineskip")):
        raise InputError(f"{path}: skips bytes before its voxels. {ONE_FILE}")
    coding = _get_field(path, fields, "encoding").lower()
    if coding in ("gzip", "gz"):
        stream = gzip.GzipFile(fileobj=file)
    elif coding in ("bzip2", "bz2"):
        stream = bz2.BZ2File(file)
    elif coding == "raw":
        stream = file
    else:
        raise InputError(f"{path}: its voxels are coded as {coding!r}: must be raw, gzip or bzip2. Save it again.")
    size = path.stat().st_size
    if length > (size if stream is file else max(BZIP2_ALLOWANCE * (coding[0] == "b"), MAX_INFLATION * size)):
        raise InputError(f"{path}: is too short for its {length:,} bytes of voxels. Copy or save it again.")
    held = bytearray()
    while len(held) < length + SURPLUS and (piece := stream.read(BLOCK)):  # to the end, where gzip stores its checksum
        held += piece
    if len(held) < length:
        raise InputError(f"{path}: ends after {len(held):,} of {length:,} bytes of voxels. Copy or save it again.")
    return bytes(held[:length])


def _parse_affine(path: Path, fields: Mapping[str, str], axes: int) -> tuple[np.ndarray, list[int]]:
    """Return the affine (4, 4) from voxel indices to metres (RAS), and the list of non-spatial axes, at most one."""
    stated = fields.get("space", "").lower()
    space = SHORT.get(stated, stated)
    if space not in SIGNS:
        said = f"its space is {stated!r}" if stated else "it does not state its space"
        raise InputError(
            f"{path}: {said}, so its left side is unknown. Save it from 3D Slicer, or state "
            f"`space: {next(reversed(SIGNS))}` if that is so; known are {', '.join(SIGNS)}."
        )
    vectors = re.findall(r"none|\([^)]*\)", _get_field(path, fields, "space directions").lower())
    across = [axis for axis, vector in enumerate(vectors) if vector == "none"]
    if len(vectors) != axes or len(across) > 1 or axes - len(across) != 3:
        raise InputError(f"{path}: has {axes} axes, of which {axes - len(across)} lie in space. {REMEDY}")
    metres = {METRES.get(unit.strip()) for unit in re.findall(r'"([^"]*)"', fields.get("space units", '""'))}
    if len(metres) != 1 or None in metres:
        raise InputError(f"{path}: its space units are {fields['space units']}. Save it in mm.")
    affine = np.eye(4)
    places = [*(vector for vector in vectors if vector != "none"), _get_field(path, fields, "space origin")]
    columns = [[float(number) for number in place.strip("() ").split(",")] for place in places]
    affine[:3] = next(iter(metres)) * (np.array(SIGNS[space])[:, None] * np.array(columns).T)
    return affine, across


def _parse_segments(path: Path, header: Mapping[str, str], layer_count: int) -> tuple[Segment, ...]:
    """Return the segments that Slicer wrote. Old files have one layer of ones for each segment and no layer keys."""
    numbers = sorted({int(found[1]) for key in header if (found := re.match(r"Segment(\d+)_", key))})
    segments = tuple(
        Segment(
            header.get(f"Segment{number}_Name", f"Segment_{number + 1}"),
            int(header.get(f"Segment{number}_Layer", number if layer_count > 1 else 0)),
            int(header.get(f"Segment{number}_LabelValue", 1)),
        )
        for number in numbers
    )
    if any(not 0 <= segment.layer < layer_count for segment in segments):
        raise InputError(f"{path}: has a segment in a missing layer. Save it again.")
    return segments
