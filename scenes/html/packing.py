"""Encoding of arrays as text for a page: byte shuffle, deflate compression and base64."""

import base64
import zlib
from collections.abc import Mapping

import numpy as np

# Types of the page's arrays, by NumPy kind and size; other types are converted to the next that holds their values.
STORED = {"f4": "f4", "f8": "f8", "i8": "i4", "i4": "i4", "i2": "i4", "u1": "u1", "u2": "u2", "b1": "u1"}


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[dict[str, tuple[str, tuple[int, ...]]], str]:
    """Pack arrays; return their types and shapes by name, in order, and their bytes as text.

    All first bytes of an array's numbers come first, then all second bytes, and so on, which improves compression.
    """
    table, parts = {}, []
    for name, array in arrays.items():
        kind = STORED[array.dtype.str[1:]]
        table[name] = kind, array.shape
        flat = np.ascontiguousarray(array, f"<{kind}").reshape(-1)
        parts.append(flat.view(np.uint8).reshape(len(flat), -1).T.tobytes())
    return table, base64.b64encode(zlib.compress(b"".join(parts), 9)).decode()
