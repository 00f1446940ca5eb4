"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError
from .partial_files import STALE, list_partials, remove_left_overs, to_partial_path


def explain_error(error: OSError) -> str:
    """Why a file cannot be had, in the system's own words and not a library's."""
    return os.strerror(error.errno) if error.errno else "the library that writes it failed"


def check_output(path: str | Path, suffix: str, stale: float = STALE, sweep: bool = True) -> Path:
    """Return the path of a file that can be written, its folder made; asked before long work, so that none is lost.

    What an earlier run of the same output left behind when it was killed is removed, unless not to `sweep` saves
    listing a folder of very many files. Another machine's unfinished file is such a left-over after `stale` seconds.

    Raises
    ------
    InputError
        A name that does not end in `suffix`, or a folder that cannot be written to.
    """
    path = Path(path)
    if path.suffix != suffix:
        raise InputError(f"{path}: this file is written as {suffix}; give a name that ends so.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: its folder cannot be made ({explain_error(error)}). Choose another folder."
        ) from error
    if path.is_dir():
        raise InputError(f"{path}: cannot be written, it is a folder. Choose another name.")
    if sweep:
        remove_left_overs(path.parent, path.name, stale)
    probe = to_partial_path(path)
    try:  # permissions alone do not tell: a file system may be read-only, or make no files
        probe.touch()
    except OSError as error:
        raise InputError(f"{path}: cannot be written there ({explain_error(error)}). Choose another folder.") from error
    finally:
        probe.unlink(missing_ok=True)
    return path


@contextmanager
def write_atomically(path: str | Path, suffix: str, sweep: bool = True) -> Iterator[Path]:
    """Yield a name beside `path`, of the same ending, to write under.

    It takes the name `path` when the block ends well.

    `sweep` is that of `check_output`.

    Raises
    ------
    InputError
        As `check_output`; and where writing fails.
    """
    path = check_output(path, suffix, sweep=sweep)
    partial = to_partial_path(path)
    try:
        yield partial
        with partial.open("rb") as file:  # whole on the disk, before it takes a name that says so
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({explain_error(error)}). {REMEDY}") from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def write_folder_atomically(path: Path, size: int = 0, kept: Callable[[Path], bool] | None = None) -> Iterator[Path]:
    """Yield a hidden folder next to `path`, which takes its name when the block ends well, and is removed if not.

    Parameters
    ----------
    size
        Bytes that it will hold, about.
    kept
        True of a hidden folder that stays all the same, as the same work resumes from it. Several processes may then
        write one folder: the first that is done gives it. Without `kept` a second process is rejected.

    Raises
    ------
    InputError
        A file, or a folder that is not empty; a full disk; a place that cannot be written; another process.
    """
    target = path.resolve()
    partial = to_partial_path(target)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{path}: is there and not empty. Choose another name, or remove it.")
    if kept is None:
        remove_left_overs(target.parent, target.name)
        shutil.rmtree(partial, ignore_errors=True)  # of a dead process that had the same number
        others = list_partials(target)
        if others:
            raise InputError(
                f"{path}: another run is writing it, in {others[0].name}. Wait for it, or choose another --out; if no "
                "run is at work, remove that folder."
            )
    check_disk_space(target, size)
    with remove_empty_parents(target):
        try:
            partial.mkdir(parents=True, exist_ok=True)
            yield partial
            if target.exists():
                target.rmdir()
            partial.rename(target)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({explain_error(error)}). {REMEDY}") from error
        finally:
            if kept is None or not kept(partial):
                shutil.rmtree(partial, ignore_errors=True)
    remove_left_overs(target.parent, target.name)


@contextmanager
def remove_empty_parents(path: Path) -> Iterator[None]:
    """Remove the folders above `path` that were made in the block and stayed empty."""
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        yield
    finally:
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def write_stream_atomically(path: str | Path, suffix: str, sweep: bool = True) -> Iterator[Stream]:
    """As `write_atomically`, but an open binary file; for HDF5, which ends the process where a write of its own fails.

    Raises
    ------
    InputError
        As `write_atomically`.
    """
    with write_atomically(path, suffix, sweep) as partial, partial.open("w+b", buffering=0) as raw:
        stream = Stream(raw)
        try:
            yield stream
        except (OSError, RuntimeError):  # what HDF5 makes of the failure when it reads again
            if stream.failure is None:
                raise
        if stream.failure is not None:
            raise stream.failure


class Stream:
    """A binary file whose first failure to write is kept in `failure`, and stated when all is done."""

    def __init__(self, raw: BinaryIO) -> None:
        self.failure: OSError | None = None
        self._raw = raw

    def write(self, data: bytes) -> int:
        """Write all of the data; nothing any more after a failure."""
        left = memoryview(data).cast("B")
        try:
            while self.failure is None and len(left):
                left = left[self._raw.write(left) :]
        except OSError as error:
            self.failure = error
        return len(data)

    def truncate(self, size: int) -> None:
        """Make the file so long."""
        try:
            self._raw.truncate(size)
        except OSError as error:
            self.failure = self.failure or error

    def read(self, size: int) -> bytes:
        """Read what was written."""
        return self._raw.read(size)

    def readinto(self, buffer: memoryview) -> int:
        """Read what was written."""
        return self._raw.readinto(buffer)  # pyright: ignore[reportAttributeAccessIssue]

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a place."""
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        """Return the place."""
        return self._raw.tell()

    def flush(self) -> None:
        """Nothing: no byte waits."""


def check_disk_space(path: str | Path, size: int, largest: int | None = None) -> None:
    """Refuse to begin what cannot end: `size` bytes beside `path`, in files of which the `largest` has so many.

    Raises
    ------
    InputError
        A disk with less room, or a limit on the size of files below the largest.
    """
    path = Path(path)
    existing = next(folder for folder in (path.parent, *path.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(existing).free
    if free < size:
        raise InputError(
            f"{path}: needs {_megabytes(size)}, and the disk has {_megabytes(free)} left. Free some, or choose "
            "another folder."
        )
    allowed, largest = _longest_file(), size if largest is None else largest
    if allowed is not None and allowed < largest:
        raise InputError(
            f"{path}: needs a file of {_megabytes(largest)}, but files are limited to {_megabytes(allowed)} here. "
            "Raise the limit (`ulimit -f`)."
        )


def _longest_file() -> int | None:
    """Bytes that a file of this process may have, or None: as many as fit."""
    try:
        import resource
    except ImportError:  # a system without such limits
        return None
    soft = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return None if soft == resource.RLIM_INFINITY else soft


REMEDY = "Choose another folder, or make room there."


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
