"""Arrays as text for a page: shuffled bytes, deflated, base64."""

import base64
import zlib
from collections.abc import Mapping

import numpy as np

# Types of the page's arrays, by NumPy kind and size; other types are converted to the next that holds their values.
STORED = {"f4": "f4", "f8": "f8", "i8": "i4", "i4": "i4", "i2": "i4", "u1": "u1", "u2": "u2", "b1": "u1"}


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[dict[str, tuple[str, tuple[int, ...]]], str]:
    """Pack arrays; return their type and shape by name, in order, and all their bytes as text.

    The first bytes of an array's numbers come first, then the second, and so on: they compress better.
    """
    table, parts = {}, []
    for name, array in arrays.items():
        kind = STORED[array.dtype.str[1:]]
        table[name] = kind, array.shape
        flat = np.ascontiguousarray(array, f"<{kind}").reshape(-1)
        parts.append(flat.view(np.uint8).reshape(len(flat), -1).T.tobytes())
    return table, base64.b64encode(zlib.compress(b"".join(parts), 9)).decode()
