"""Rows of a table on disk while it is made, so that a stopped run goes on with them."""

from __future__ import annotations

import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MAGIC = b"sulcus rows 1 "
SUM = 4


@dataclass(frozen=True)
class KeptRows:
    """The first rows of a table in a file; a place that cannot be written, or is full, keeps none.

    Each row has a checksum of its number and bytes. What follows a row that is torn or out of order is made anew.

    Parameters
    ----------
    path
        The file. One that is of something else stays as it is, and nothing is kept.
    what
        Tells the table from every other; rows of another are dropped.
    """

    path: Path
    what: str

    @property
    def some(self) -> bool:
        """Whether rows of this table are there."""
        with suppress(OSError), self.path.open("rb") as file:
            return file.read(len(self._head)) == self._head and len(file.read(1)) > 0
        return False

    def restore(self, table: np.ndarray) -> int:
        """Fill the first rows of a table (P, ...) with those that are kept; how many."""
        head, size, count = self._head, table[0].nbytes, 0
        with suppress(OSError):
            if not self.path.exists():
                self.path.write_bytes(head)
            with self.path.open("r+b") as file:
                found = file.read(len(head))
                if not found.startswith(MAGIC):
                    return 0
                while found == head and count < len(table):
                    row, stated = file.read(size), file.read(SUM)
                    if len(row) < size or stated != _sum(count, row):
                        break
                    table[count] = np.frombuffer(row, table.dtype).reshape(table.shape[1:])
                    count += 1
                file.seek(0)
                file.write(head)
                file.truncate(len(head) + count * (size + SUM))
        return count

    def add(self, first: int, rows: np.ndarray) -> None:
        """Keep rows (k, ...), of which the first has this number."""
        with suppress(OSError), self.path.open("r+b") as file:
            if file.read(len(self._head)) != self._head:
                return
            file.seek(0, 2)
            for number, row in enumerate(rows, first):
                file.write(row.tobytes() + _sum(number, row.tobytes()))

    @property
    def _head(self) -> bytes:
        return MAGIC + self.what.encode() + b"\n"


def _sum(number: int, row: bytes) -> bytes:
    return zlib.crc32(row, number).to_bytes(SUM, "little")
