"""How much a `.vtu` file inflates to, found without inflating it whole: a few bytes may stand for gigabytes."""

from __future__ import annotations

import base64
import lzma
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .errors import InputError

# Bytes inflated at once.
PIECE = 2**20
OPENERS = {"vtkZLibDataCompressor": zlib.decompressobj, "vtkLZMADataCompressor": lzma.LZMADecompressor}


def demand_small(path: Path, most: int) -> None:
    """Refuse a file whose arrays inflate to more than `most` bytes in all; binary data outside XML are not counted.

    Raises
    ------
    InputError
        Naming the limit.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:
        return
    opener = OPENERS.get(root.get("compressor", ""))
    if opener is None:
        return
    word = np.dtype({"UInt64": "u8"}.get(root.get("header_type", ""), "u4"))
    word = word.newbyteorder(">" if root.get("byte_order") == "BigEndian" else "<")
    appended = (root.findtext("AppendedData") or "").strip().lstrip("_")
    left = most
    for array in root.iter("DataArray"):
        inside = appended[int(array.get("offset", 0)) :] if array.get("format") == "appended" else array.text or ""
        if array.get("format") in ("binary", "appended"):
            for block in _blocks(inside.strip(), word):
                left -= _inflated(opener(), block, left)
                if left < 0:
                    raise InputError(f"its arrays inflate to more than {most / 1e9:.3g} GB: it is no mesh of a brain.")


def _blocks(text: str, word: np.dtype) -> Iterator[bytes]:
    """The packed blocks of an array, behind a header of their number, two sizes, and the size of each."""
    count = int(np.frombuffer(base64.b64decode(text[: _letters(word.itemsize)]), word, 1)[0])
    header = _letters(word.itemsize * (3 + count))
    sizes = np.frombuffer(base64.b64decode(text[:header]), word)[3 : 3 + count]
    packed = base64.b64decode(text[header : header + _letters(sum(map(int, sizes)))])
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
