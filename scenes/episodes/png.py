"""PNG encoding of grey images with ISA-L, which is 4 (depth) to 10 times (labels) as fast as zlib at equal size."""

import struct

import numpy as np

from sim.runtime.optional_packages import require_extra

with require_extra("data", "writing an episode needs"):
    from isal import isal_zlib

SIGNATURE = b"\x89PNG\r\n\x1a\n"  # First bytes of a PNG.
GREY, SUB = 0, 1
"""PNG's codes of the grey colour type, and of the row filter that subtracts the sample to the left."""
LEVEL = 1  # Compression level.


def encode_png(image: np.ndarray) -> np.ndarray:
    """Encode a grey image (H, W) uint8 or uint16 as the bytes (n,) uint8 of a PNG file.

    ISO/IEC 15948: one IDAT chunk, and the filter Sub in all rows. Equal images give equal bytes.
    """
    height, width = image.shape
    bits = 8 * image.itemsize
    header = struct.pack(">IIBBBBB", width, height, bits, GREY, 0, 0, 0)
    packed = isal_zlib.compress(_filter_rows(image), LEVEL)
    code = SIGNATURE + _encode_chunk(b"IHDR", header) + _encode_chunk(b"IDAT", packed) + _encode_chunk(b"IEND", b"")
    return np.frombuffer(code, np.uint8)


def _filter_rows(image: np.ndarray) -> np.ndarray:
    """Filter the rows: the filter's number, then each byte minus the corresponding byte of the sample to its left."""
    height, width = image.shape
    size = image.itemsize
    samples = image.astype(image.dtype.newbyteorder(">"), order="C").view(np.uint8).reshape(height, size * width)
    rows = np.empty((height, 1 + size * width), np.uint8)
    rows[:, 0] = SUB
    rows[:, 1 : 1 + size] = samples[:, :size]
    np.subtract(samples[:, size:], samples[:, :-size], out=rows[:, 1 + size :])
    return rows


def _encode_chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(name)))
