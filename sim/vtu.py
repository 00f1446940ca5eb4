"""How much a `.vtu` file inflates to, found without inflating it whole: a few bytes may stand for gigabytes."""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .limits import too_large

RAW = re.compile(rb'<AppendedData[^>]*encoding="raw"[^>]*>')
# Bytes inflated at once.
PIECE = 2**20
OPENERS = {"vtkZLibDataCompressor": zlib.decompressobj, "vtkLZMADataCompressor": lzma.LZMADecompressor}


def demand_small(path: Path, most: int) -> bool:
    """Refuse a file whose arrays inflate to more than `most` bytes in all.

    False of a file that is no XML, whose arrays it cannot count.

    Raises
    ------
    InputError
        Naming the limit.
    """
    text, behind = path.read_bytes(), None
    raw = RAW.search(text)
    if raw:  # bytes that no XML may hold
        end = text.rfind(b"</AppendedData>")
        text, behind = text[: raw.end()] + text[end:], text[raw.end() : end].lstrip()[1:]
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return False
    opener = OPENERS.get(root.get("compressor", ""))
    if opener is None:
        return True
    word = np.dtype({"UInt64": "u8"}.get(root.get("header_type", ""), "u4"))
    word = word.newbyteorder(">" if root.get("byte_order") == "BigEndian" else "<")
    if behind is None:
        behind = (root.findtext("AppendedData") or "").strip().lstrip("_")
    left = most
    for array in root.iter("DataArray"):
        kind = array.get("format")
        if kind in ("binary", "appended"):
            inside = behind[int(array.get("offset", 0)) :] if kind == "appended" else (array.text or "").strip()
            for block in _blocks(inside, word):
                left -= _inflated(opener(), block, left)
                if left < 0:
                    raise too_large(most)
    return True


def _blocks(inside: str | bytes, word: np.dtype) -> Iterator[bytes]:
    """The packed blocks of an array, behind a header of their number, two sizes, and the size of each.

    `inside` is raw, or the header and the blocks are in base64.
    """

    def part(place: int, size: int) -> bytes:
        if isinstance(inside, bytes):
            return inside[place : place + size]
        return base64.b64decode(inside[place : place + _letters(size)])

    count = int(np.frombuffer(part(0, word.itemsize), word, 1)[0])
    header = word.itemsize * (3 + count)
    sizes = np.frombuffer(part(0, header), word)[3 : 3 + count]
    packed = part(header if isinstance(inside, bytes) else _letters(header), sum(map(int, sizes)))
    place = 0
    for size in map(int, sizes):
        yield packed[place : place + size]
        place += size


def _letters(size: int) -> int:
    """Letters of base64 for so many bytes."""
    return -(-size // 3) * 4


def _inflated(opened: Any, block: bytes, most: int) -> int:
    """Bytes that a block inflates to, or some number above `most`."""
    total, rest = 0, block
    while total <= most and not opened.eof:
        piece = opened.decompress(rest, PIECE)
        rest = getattr(opened, "unconsumed_tail", b"")
        total += len(piece)
        if not piece and not rest:
            break
    return total
