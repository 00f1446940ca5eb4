"""Pictures out of JPEG and PNG bytes from outside: none is decoded that is not of the size it should have."""

from __future__ import annotations

import struct

import cv2
import numpy as np

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
PNG_END, JPEG_END = b"IEND\xaeB`\x82", b"\xff\xd9"
# Markers of a JPEG's frame header, which states its size; of those between, the coders' tables are none.
SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
AS_STORED = cv2.IMREAD_IGNORE_ORIENTATION
"""Not turned as a file may ask: its camera matrix is not."""


def stated_size(code: bytes) -> tuple[int, int]:
    """Width and height [pixel] that a JPEG or a PNG states of itself; nothing is decoded.

    Raises
    ------
    ValueError
        Bytes that are neither, or that end too early.
    """
    ending = PNG_END if code.startswith(PNG) else JPEG_END if code.startswith(JPEG) else None
    if ending is None:
        raise ValueError("it is neither a JPEG nor a PNG")
    if not code.endswith(ending):
        raise ValueError("it ends too early")
    try:
        if ending is PNG_END:
            width, height = struct.unpack_from(">II", code, 16)
            return width, height
        place = 2
        while True:
            mark, kind, length = struct.unpack_from(">BBH", code, place)
            if mark != 0xFF or length < 2:
                raise ValueError("its header is damaged")
            if kind in SIZED:
                height, width = struct.unpack_from(">HH", code, place + 5)
                return width, height
            place += 2 + length
    except struct.error as error:
        raise ValueError("its header is damaged") from error


def decoded_colour(code: bytes, width: int, height: int) -> np.ndarray:
    """A picture (height, width, 3) uint8 sRGB.

    Raises
    ------
    ValueError
        Bytes that are no such picture, or one of another size.
    """
    return _decoded(code, (height, width, 3), cv2.IMREAD_COLOR_RGB | AS_STORED, np.uint8)


def decoded_depth(code: bytes, width: int, height: int, scale: float) -> np.ndarray:
    """Depth (height, width) float32 [m] out of a PNG of 16 bits whose step is `scale` [m]; 0 where nothing is seen.

    Raises
    ------
    ValueError
        As `decoded_colour`.
    """
    steps = _decoded(code, (height, width), cv2.IMREAD_UNCHANGED | AS_STORED, np.uint16)
    return steps * np.float32(scale)


def decoded_labels(code: bytes, width: int, height: int) -> np.ndarray:
    """Labels (height, width) uint8 out of a PNG of 8 bits.

    Raises
    ------
    ValueError
        As `decoded_colour`.
    """
    return _decoded(code, (height, width), cv2.IMREAD_UNCHANGED | AS_STORED, np.uint8)


def _decoded(code: bytes, shape: tuple[int, ...], flag: int, kind: type) -> np.ndarray:
    width, height = stated_size(code)
    if (height, width) != shape[:2]:
        raise ValueError(f"it has {width} x {height} pixels in place of {shape[1]} x {shape[0]}")
    try:
        picture = cv2.imdecode(np.frombuffer(code, np.uint8), flag)
    except cv2.error as error:
        raise ValueError("it is damaged") from error
    if picture is None:
        raise ValueError("it is damaged")
    if picture.shape != shape or picture.dtype != kind:
        channels = 1 if picture.ndim == 2 else picture.shape[2]
        raise ValueError(f"it has {channels} channels of {8 * picture.dtype.itemsize} bits")
    return picture
