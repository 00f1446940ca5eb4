"""Measurement of the uncompressed size of a `.vtu` file in bounded memory, since few bytes may expand to gigabytes."""

import base64
import lzma
import re
import zlib
from collections.abc import Callable, Iterator
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..errors import InputError
from ..runtime.file_limits import build_too_large_error

# Start of raw appended data, as meshio finds it.
RAW = re.compile(rb'<AppendedData[^>]+">')
# Block size of decompression [bytes].
BLOCK = 2**20
# Decompressor by VTK name.
OPENERS = {"vtkZLibDataCompressor": zlib.decompressobj, "vtkLZMADataCompressor": lzma.LZMADecompressor}
WORDS = {"UInt32": "u4", "UInt64": "u8"}  # header word type


def check_vtu_size(path: Path, max_bytes: int) -> bool:
    """Reject a file whose compressed arrays expand to more than `max_bytes` bytes, or to more than their declared size.

    Return True if all arrays could be measured; False if the file is not XML or its data is raw or not compressed.

    Raises
    ------
    InputError
        The file is too large; the message gives the limit.
    """
    text, behind = path.read_bytes(), None
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:  # raw bytes are not valid XML
        raw = RAW.search(text)
        if raw is None:
            return False
        end = text.find(b"</AppendedData>")
        behind = text[raw.end() : end].lstrip()[1:]
        try:
            root = ElementTree.fromstring(text[: raw.end()] + text[end:])
        except ElementTree.ParseError:
            return False
    headed = root.get("header_type", "UInt32")
    if headed not in WORDS:
        raise InputError(f"its header_type is {headed!r}. Write it again with {' or '.join(WORDS)}.")
    opener = OPENERS.get(root.get("compressor", ""))
    if opener is None:
        if root.get("compressor"):
            raise InputError(
                f"its arrays are packed by {root.get('compressor')}, and {', '.join(OPENERS)} are read. Write it so."
            )
        return False
    word = np.dtype(WORDS[headed]).newbyteorder(">" if root.get("byte_order") == "BigEndian" else "<")
    raw = behind is not None
    if behind is None:
        behind = (root.findtext("AppendedData") or "").strip()[1:]
    left = max_bytes
    for array in root.iter("DataArray"):
        kind = array.get("format")
        if kind in ("binary", "appended"):
            inside = behind[int(array.get("offset", 0)) :] if kind == "appended" else (array.text or "").strip()
            declared, blocks = _parse_blocks(inside, word)
            left -= declared
            if left < 0:
                raise build_too_large_error(max_bytes)
            for block in blocks:
                declared -= _measure_inflated_size(opener, block, declared)
                if declared < 0:
                    raise InputError("an array inflates to more than its header says. Write the file again.")
    return not raw


def _parse_blocks(content: str | bytes, header_type: np.dtype) -> tuple[int, Iterator[bytes]]:
    """Return the declared size of an array [bytes], and an iterator over its compressed blocks.

    The blocks follow a header: number of blocks, size of a block, size of the last block, compressed size of each.
    `content` contains raw bytes, or header and blocks in base64.
    """

    def read_part(start: int, size: int) -> bytes:
        if isinstance(content, bytes):
            return content[start : start + size]
        return base64.b64decode(content[start : start + _count_base64_characters(size)])

    count = int(np.frombuffer(read_part(0, header_type.itemsize), header_type, 1)[0])
    header = header_type.itemsize * (3 + count)
    size, _, *sizes = map(int, np.frombuffer(read_part(0, header), header_type)[1 : 3 + count])
    packed = read_part(header if isinstance(content, bytes) else _count_base64_characters(header), sum(sizes))
    ends = [0, *accumulate(sizes)]
    return count * size, (packed[start:end] for start, end in pairwise(ends))


def _count_base64_characters(size: int) -> int:
    """Return the number of base64 characters that encode `size` bytes."""
    return -(-size // 3) * 4


def _measure_inflated_size(opener: Callable[[], Any], block: bytes, max_size: int) -> int:
    """Return the decompressed size [bytes] of all streams of a block, or any number above `max_size` if larger."""
    total, rest = 0, block
    while rest and total <= max_size:
        opened = opener()
        while total <= max_size and not opened.eof:
            piece, rest = opened.decompress(rest, BLOCK), getattr(opened, "unconsumed_tail", b"")
            total += len(piece)
            if not piece and not rest:
                return total
        rest = opened.unused_data
    return total
