"""A name for what acts on a body: two answers may be compared where it is the same."""

from __future__ import annotations

import hashlib

from sim.loads import Loads


def stamp(loads: Loads) -> str:
    """Digest of the kinds, the numbers and the times of loads."""
    digest = hashlib.blake2b(loads.times.tobytes(), digest_size=12)
    for cause in loads.causes:
        digest.update(type(cause).__name__.encode())
        for name, array in vars(cause).items():
            digest.update(f"{name}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
