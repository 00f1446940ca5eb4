"""HDF5 files that one process holds open, a bounded number of them."""

from __future__ import annotations

import os
from collections import OrderedDict
from pathlib import Path

import h5py

from sim.errors import InputError
from sim.runtime.outside_files import read_as

HINT = "`sulcus validate` says more; "
REMEDY = f"{HINT}make it anew, or leave it out."


def opened(path: Path) -> h5py.File:
    """An episode's file; InputError where it is not there, or no HDF5."""
    with read_as(path, "an episode", REMEDY):
        return h5py.File(path, "r")


def said_by_validate(error: InputError, path: Path) -> str:
    """What is wrong with an episode, without its path, and without the hint to the command that says it."""
    return str(error).removeprefix(f"{path}: ").replace(f"{HINT}make", "Make")


class OpenFiles:
    """Files that are opened when they are first read, in the process that reads them; those read least go first.

    A process that is forked opens its own, and one that gets this by pickling too.
    """

    def __init__(self, most: int = 16) -> None:
        if most < 1:
            raise InputError(f"{most} open files: at least one must be.")
        self.most = most
        self._process = os.getpid()
        self._open: OrderedDict[Path, h5py.File] = OrderedDict()

    def __reduce__(self) -> tuple[type[OpenFiles], tuple[int]]:
        return OpenFiles, (self.most,)

    def __len__(self) -> int:
        return len(self._open)

    def file(self, path: Path) -> h5py.File:
        """The open file.

        Raises
        ------
        InputError
            A file that is not there, or no HDF5.
        """
        if self._process != os.getpid():
            self.close()
            self._process = os.getpid()
        if path not in self._open:
            while len(self._open) >= self.most:
                self._open.popitem(last=False)[1].close()
            self._open[path] = opened(path)
        self._open.move_to_end(path)
        return self._open[path]

    def close(self) -> None:
        """Close all."""
        while self._open:
            self._open.popitem()[1].close()
