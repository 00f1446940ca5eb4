"""Contents of OpenIGTLink messages: decoding of TRANSFORM, POSITION, POINT and IMAGE, and encoding for sending.

Lengths are millimetres here, as in the protocol. Layouts: openigtlink.org/protocols, version 2.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.spatial.transform import Rotation

from .frame import BadMessageError

FLOAT_TYPE = np.dtype(">f4")  # Type of numbers in a message.
INTEGER_TYPE = np.dtype(">u4")  # Type of integers in a message.
# Image header: version, components, scalar type, endianness, space, sizes, axes and centre, start and sizes of the
# part.
IMAGE = struct.Struct(">HBBBB3H12f6H")
POINT = struct.Struct(">64s32s4B3ff20s")  # Point: name, group, colour, position, diameter, owner.
STATUS = struct.Struct(">Hq20s")  # Status: code, subcode, name of the error.
BYTES, BIG, RAS = 3, 1, 1  # OpenIGTLink's numbers: unsigned bytes; big-endian; coordinates in RAS.
ASCII = 3  # Number of the encoding US-ASCII.
MAX_TEXT_BYTES = (1 << 16) - 1  # Maximum length of a text [bytes].


class Status(IntEnum):
    """Codes of STATUS messages."""

    OK = 1
    NOT_FOUND = 4
    BUSY = 6
    TIMEOUT = 7
    OVERFLOW = 8
    CHECKSUM = 9
    CONFIGURATION = 10
    UNKNOWN_INSTRUCTION = 12
    NOT_READY = 13
    SHUTDOWN = 19


@dataclass(frozen=True, eq=False)
class EncodedMesh:
    """Encoded triangles (m, 3) of a moving surface, which are the same in all messages."""

    count: int
    cells: bytes

    @staticmethod
    def from_triangles(triangles: np.ndarray) -> EncodedMesh:
        """Encode triangles (m, 3), which are vertex numbers."""
        rows = np.full((len(triangles), 4), 3, INTEGER_TYPE)
        rows[:, 1:] = triangles
        return EncodedMesh(len(triangles), rows.tobytes())


EMPTY_MESH = EncodedMesh(0, b"")
"""Surface without triangles, for a surface that is not available."""


def encode_polydata(points: np.ndarray, mesh: EncodedMesh) -> bytes:
    """Encode a surface with vertices (n, 3) [mm] as POLYDATA."""
    head = struct.pack(">10I", len(points), 0, 0, 0, 0, mesh.count, len(mesh.cells), 0, 0, 0)
    return head + np.ascontiguousarray(points, FLOAT_TYPE).tobytes() + mesh.cells


def encode_transform(T: np.ndarray) -> bytes:
    """Encode a rigid transform (4, 4) [mm] as TRANSFORM, column by column."""
    return np.ascontiguousarray(T[:3].T, FLOAT_TYPE).tobytes()


def read_transform(content: bytes) -> np.ndarray:
    """Decode the matrix (4, 4) [mm] of a TRANSFORM; the matrix may not be rigid.

    Raises
    ------
    BadMessageError
        The content has the wrong size.
    """
    T = np.eye(4)
    T[:3] = _read_floats(content, 12).reshape(4, 3).T
    return T


def read_position(content: bytes) -> np.ndarray:
    """Decode a POSITION, a translation and a unit quaternion with the real part last, as matrix (4, 4) [mm].

    Raises
    ------
    BadMessageError
        The content has the wrong size, for example a position without orientation; or the quaternion is invalid.
    """
    numbers = _read_floats(content, 7)
    if not abs(np.linalg.norm(numbers[3:]) - 1.0) < 1e-2:
        raise BadMessageError("its quaternion is not of length 1")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
    return T


def _read_floats(content: bytes, count: int) -> np.ndarray:
    if len(content) != FLOAT_TYPE.itemsize * count:
        raise BadMessageError(f"wrong size: {len(content)} bytes in place of {FLOAT_TYPE.itemsize * count}")
    return np.frombuffer(content, FLOAT_TYPE).astype(float)


def encode_points(names: list[str], positions: np.ndarray) -> bytes:
    """Encode named points (n, 3) [mm] as POINT."""
    rows = zip(names, positions.tolist(), strict=True)
    return b"".join(
        POINT.pack(name.encode("ascii", "replace")[:64], b"", 255, 255, 0, 255, *place, 0.0, b"")
        for name, place in rows
    )


def read_points(content: bytes) -> tuple[list[str], np.ndarray]:
    """Decode the names and positions (n, 3) [mm] of a POINT.

    Raises
    ------
    BadMessageError
        The content has the wrong size, or positions are not finite.
    """
    if len(content) % POINT.size:
        raise BadMessageError(f"wrong size: {len(content)} bytes, no multiple of {POINT.size}")
    rows = list(POINT.iter_unpack(content))
    places = np.array([row[6:9] for row in rows], float).reshape(-1, 3)
    if not np.isfinite(places).all():
        raise BadMessageError("holds a place that is not finite")
    return [row[0].split(b"\0", 1)[0].decode("ascii", "replace") for row in rows], places


def encode_image(image: np.ndarray) -> bytes:
    """Encode an image (H, W, 3) uint8 as IMAGE, with pixels of 1 mm around the origin."""
    height, width, channels = image.shape
    size = width, height, 1
    axes = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    return IMAGE.pack(1, channels, BYTES, BIG, RAS, *size, *axes, 0, 0, 0, *size) + image.tobytes()


def read_image(content: bytes) -> np.ndarray:
    """Decode the image (H, W, 3) uint8 of an IMAGE; a grey image has three equal channels.

    Raises
    ------
    BadMessageError
        The content is not a complete 8-bit image in grey, RGB or RGBA.
    """
    if len(content) < IMAGE.size:
        raise BadMessageError("is too short for an image")
    _, channels, kind, _, _, *numbers = IMAGE.unpack_from(content)
    size, part = numbers[:3], numbers[15:]
    width, height, depth = size
    if kind != BYTES or depth != 1 or channels not in (1, 3, 4) or part != [0, 0, 0, *size]:
        raise BadMessageError("is not one complete 8-bit image in grey or RGB")
    if len(content) != IMAGE.size + width * height * channels:
        raise BadMessageError("holds another number of pixels than it names")
    pixels = np.frombuffer(content, np.uint8, offset=IMAGE.size).reshape(height, width, channels)
    return np.ascontiguousarray(np.broadcast_to(pixels, (height, width, 3)) if channels == 1 else pixels[..., :3])


def encode_string(text: str) -> bytes:
    """Encode an ASCII text as STRING."""
    raw = text.encode("ascii", "replace")[:MAX_TEXT_BYTES]
    return struct.pack(">HH", ASCII, len(raw)) + raw


def encode_status(code: Status, text: str) -> bytes:
    """Encode a code, its name and a text as STATUS."""
    name = "" if code is Status.OK else code.name
    return STATUS.pack(code, 0, name.encode()) + text.encode("ascii", "replace") + b"\0"
