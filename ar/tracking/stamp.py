"""A time written into a picture as a strip of black and white cells, which outlives the codecs of films."""

from __future__ import annotations

import numpy as np

# Side of a cell [pixel]; the part of it that is read, from its border on; cells that begin every strip.
CELL, INNER, BEGIN = 8, 2, (1, 0, 1, 0)
# Bits of the time, in units of [s], and of its check sum.
TIME_BITS, UNIT, CHECK_BITS = 32, 1e-4, 8
CELLS = len(BEGIN) + TIME_BITS + CHECK_BITS
WIDTH = CELL * CELLS
"""Columns that a strip takes [pixel]."""
# Grey values under which a cell is black, and above which it is white.
BLACK, WHITE = 90.0, 165.0


def stamped(colour: np.ndarray, time: float) -> np.ndarray:
    """A picture (H, W, 3) or (H, W) uint8 with a time [s] in its upper right corner; a copy.

    Raises
    ------
    ValueError
        A time that is negative or longer than five days, or a picture that is too narrow.
    """
    count = round(time / UNIT) if np.isfinite(time) else -1
    if not 0 <= count < 2**TIME_BITS:
        raise ValueError(
            f"a picture cannot have the time {time:g} s written into it: give 0 to {2**TIME_BITS * UNIT:g} s."
        )
    if colour.shape[0] < CELL or colour.shape[1] < WIDTH:
        raise ValueError(
            f"a time needs {WIDTH} x {CELL} pixels: the picture has {colour.shape[1]} x {colour.shape[0]}."
        )
    bits = [*BEGIN, *_bits(count, TIME_BITS), *_bits(_check(count), CHECK_BITS)]
    strip = np.kron(np.array(bits, np.uint8), np.ones((CELL, CELL), np.uint8)) * 255
    out = colour.copy()
    out[:CELL, -WIDTH:] = strip if colour.ndim == 2 else strip[..., None]
    return out


def read_stamp(grey: np.ndarray) -> float | None:
    """The time [s] in the upper right corner of a picture (H, W) uint8; None where there is none, or a damaged one."""
    if grey.shape[0] < CELL or grey.shape[1] < WIDTH:
        return None
    cells = grey[INNER : CELL - INNER, -WIDTH:].reshape(CELL - 2 * INNER, CELLS, CELL)[..., INNER : CELL - INNER]
    means = cells.mean(axis=(0, 2))
    if ((means > BLACK) & (means < WHITE)).any():
        return None
    bits = (means >= WHITE).astype(int).tolist()
    count = _number(bits[len(BEGIN) : len(BEGIN) + TIME_BITS])
    sound = tuple(bits[: len(BEGIN)]) == BEGIN and _number(bits[-CHECK_BITS:]) == _check(count)
    return count * UNIT if sound else None


def _bits(number: int, count: int) -> list[int]:
    return [(number >> place) & 1 for place in reversed(range(count))]


def _number(bits: list[int]) -> int:
    return sum(bit << place for place, bit in enumerate(reversed(bits)))


def _check(count: int) -> int:
    """Eight bits that a damaged time seldom has: bytes weighted by odd numbers, so that none may change places."""
    return (0xA5 + sum((2 * k + 3) * byte for k, byte in enumerate(count.to_bytes(TIME_BITS // 8, "big")))) % 256
