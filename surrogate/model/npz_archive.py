"""Arrays in an `.npz` from outside: only those asked for are read, and none that is larger than it may be."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from numpy.lib import format as npy

from sim.errors import InputError
from sim.runtime.atomic_files import written_whole
from sim.runtime.file_limits import LARGEST_HEADER, LARGEST_MODEL
from sim.runtime.outside_files import read_as

# Of an array's own header.
LONGEST = 10_000


def kept_arrays(
    path: Path | None,
    kind: str,
    names: Iterable[str],
    make: Callable[[], Mapping[str, np.ndarray]],
    check: Callable[[Mapping[str, np.ndarray]], object] = lambda arrays: None,
) -> Mapping[str, np.ndarray]:
    """Arrays of some names from a file, if it is there; else they are made, and kept there. No path: only made.

    `kind` is what the file holds, with its article; `check` refuses arrays that were read.

    Raises
    ------
    InputError
        A file that cannot be read, or that the check refuses.
    """
    if path is not None and path.exists():
        with read_as(path, kind, "Delete it: it is made anew."), path.open("rb") as raw:
            found = Archive(raw).arrays(names)
            check(found)
            return found
    made = make()
    if path is not None:
        with written_whole(path, ".npz") as unfinished:
            np.savez(unfinished, **made)  # pyright: ignore[reportArgumentType]
    return made


class Archive:
    """The arrays of an open `.npz` file, of at most `largest` bytes together.

    Reading the wrong kind of file raises what `zipfile` and NumPy raise.
    """

    def __init__(self, file: BinaryIO, largest: int = LARGEST_MODEL) -> None:
        self._zip, self._largest = zipfile.ZipFile(file), largest

    def text(self, name: str) -> str:
        """An array of one text.

        Raises
        ------
        InputError
            A text that is longer than it may be.
        """
        self._demand([name], LARGEST_HEADER)
        return str(self._array(name))

    def arrays(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Arrays by name.

        Raises
        ------
        InputError
            Arrays that are missing, or larger in all than they may be.
        """
        wanted = sorted(set(names))
        self._demand(wanted, self._largest)
        return {name: self._array(name) for name in wanted}

    def _demand(self, names: list[str], most: int) -> None:
        held = {info.filename: info for info in self._zip.infolist()}
        missing = [name for name in names if f"{name}.npy" not in held]
        if missing:
            raise InputError(f"lacks the array {missing[0]!r}: it is damaged. Make one with `sulcus train`.")
        size = sum(held[f"{name}.npy"].file_size for name in names)
        if size > most:
            raise InputError(
                f"has arrays of {size / 1e6:,.0f} MB, and {most / 1e6:,.0f} MB are the most: it is no model of this "
                "version. Make one with `sulcus train`."
            )

    def _array(self, name: str) -> np.ndarray:
        info = self._zip.getinfo(f"{name}.npy")
        with self._zip.open(info) as member:
            # Its size is declared here and in the archive: memory is taken where both agree.
            version = npy.read_magic(member)
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, _, kind = read(member, max_header_size=LONGEST)
            if kind.hasobject or math.prod(shape) * kind.itemsize > info.file_size:
                raise InputError(
                    f"its array {name!r} is not what it says: it is damaged. Make one with `sulcus train`."
                )
        with self._zip.open(info) as member:
            return cast(np.ndarray, npy.read_array(member, allow_pickle=False, max_header_size=LONGEST))
