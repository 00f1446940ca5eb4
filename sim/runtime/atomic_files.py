"""Atomic writing: a file or folder appears completely or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError
from .partial_files import STALE_SECONDS, list_partials, remove_partial_files, to_partial_path


def explain_error(error: OSError) -> str:
    """Return the reason of an OSError in the words of the operating system, not those of a library."""
    return os.strerror(error.errno) if error.errno else "the library that writes it failed"


def check_output(path: str | Path, suffix: str, max_age: float = STALE_SECONDS, remove_partials: bool = True) -> Path:
    """Return a writable path, whose folder is created; call this before long work, so that no result is lost.

    Unfinished files of killed runs with the same output are removed, unless `remove_partials` is False, which saves
    time in very large folders. Unfinished files of other machines are removed after `max_age` seconds.

    Raises
    ------
    InputError
        The name does not end in `suffix`, or the folder is not writable.
    """
    path = Path(path)
    if path.suffix != suffix:
        raise InputError(f"{path}: this file is written as {suffix}: give a name with this extension.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: its folder cannot be created ({explain_error(error)}). Choose another folder."
        ) from error
    if path.is_dir():
        raise InputError(f"{path}: cannot be written, it is a folder. Choose another name.")
    if remove_partials:
        remove_partial_files(path.parent, path.name, max_age)
    probe = to_partial_path(path)
    try:  # permissions are not enough: the file system may be read-only or full
        probe.touch()
    except OSError as error:
        raise InputError(f"{path}: cannot be written there ({explain_error(error)}). Choose another folder.") from error
    finally:
        probe.unlink(missing_ok=True)
    return path


@contextmanager
def write_atomically(path: str | Path, suffix: str, remove_partials: bool = True) -> Iterator[Path]:
    """Yield a temporary path next to `path`, with the same suffix, which is renamed to `path` if the block succeeds.

    `remove_partials` has the same meaning as in `check_output`.

    Raises
    ------
    InputError
        See `check_output`; also if writing fails.
    """
    path = check_output(path, suffix, remove_partials=remove_partials)
    partial = to_partial_path(path)
    try:
        yield partial
        with partial.open("rb") as file:  # complete on the disk before it is renamed
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({explain_error(error)}). {REMEDY}") from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def write_folder_atomically(path: Path, size: int = 0, is_kept: Callable[[Path], bool] | None = None) -> Iterator[Path]:
    """Yield a hidden folder next to `path`, which is renamed to `path` if the block succeeds, and else removed.

    Parameters
    ----------
    size
        Expected size of the content [bytes].
    is_kept
        Function that returns True if a hidden folder is kept after a failure, so that the same work can be resumed.
        Then several processes may write one folder, and the process that finishes first renames the folder. Without
        `is_kept`, a second process is rejected.

    Raises
    ------
    InputError
        `path` is a file or a folder that is not empty, is not writable, or is in use; or the disk is full.
    """
    target = path.resolve()
    partial = to_partial_path(target)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{path}: exists and is not empty. Choose another name, or remove it.")
    if is_kept is None:
        remove_partial_files(target.parent, target.name)
        shutil.rmtree(partial, ignore_errors=True)  # left by a dead process with the same number
        others = list_partials(target)
        if others:
            raise InputError(
                f"{path}: another run is writing it, in {others[0].name}. Wait for it, or choose another --out; if no "
                "run is active, remove that folder."
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
            if is_kept is None or not is_kept(partial):
                shutil.rmtree(partial, ignore_errors=True)
    remove_partial_files(target.parent, target.name)


@contextmanager
def remove_empty_parents(path: Path) -> Iterator[None]:
    """Remove the folders above `path` that the block created and that are empty at its end."""
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        yield
    finally:
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def write_stream_atomically(path: str | Path, suffix: str, remove_partials: bool = True) -> Iterator[Stream]:
    """Yield an open binary file, as `write_atomically`, for HDF5, which would end the process if its own write failed.

    Raises
    ------
    InputError
        See `write_atomically`.
    """
    with write_atomically(path, suffix, remove_partials) as partial, partial.open("w+b", buffering=0) as raw:
        stream = Stream(raw)
        try:
            yield stream
        except (OSError, RuntimeError):  # raised by HDF5 when it reads after a failure
            if stream.failure is None:
                raise
        if stream.failure is not None:
            raise stream.failure


class Stream:
    """Binary file that stores its first write error in `failure`, to be raised at the end."""

    def __init__(self, file: BinaryIO) -> None:
        self.failure: OSError | None = None
        self._raw = file

    def write(self, data: bytes) -> int:
        """Write all data and return its size; after a failure, write nothing."""
        left = memoryview(data).cast("B")
        try:
            while self.failure is None and len(left):
                left = left[self._raw.write(left) :]
        except OSError as error:
            self.failure = error
        return len(data)

    def truncate(self, size: int) -> None:
        """Set the length of the file [bytes]."""
        try:
            self._raw.truncate(size)
        except OSError as error:
            self.failure = self.failure or error

    def read(self, size: int) -> bytes:
        """Read bytes that were written."""
        return self._raw.read(size)

    def readinto(self, buffer: memoryview) -> int:
        """Read bytes that were written into a buffer."""
        return self._raw.readinto(buffer)  # pyright: ignore[reportAttributeAccessIssue]

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position in the file."""
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        """Return the position in the file."""
        return self._raw.tell()

    def flush(self) -> None:
        """Do nothing, since the file is not buffered."""


def check_disk_space(path: str | Path, size: int, largest_file: int | None = None) -> None:
    """Reject a path if `size` bytes, in files of at most `largest_file` bytes, do not fit next to `path`.

    Raises
    ------
    InputError
        There is too little free space, or the file size limit is below `largest_file`.
    """
    path = Path(path)
    existing = next(folder for folder in (path.parent, *path.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(existing).free
    if free < size:
        raise InputError(
            f"{path}: needs {_to_mb(size)}, and the disk has {_to_mb(free)} left. Free space, or choose another folder."
        )
    allowed, largest_file = _get_max_file_size(), size if largest_file is None else largest_file
    if allowed is not None and allowed < largest_file:
        raise InputError(
            f"{path}: needs a file of {_to_mb(largest_file)}, but files are limited to {_to_mb(allowed)} here. "
            "Raise the limit (`ulimit -f`)."
        )


def _get_max_file_size() -> int | None:
    """Return the maximum size of a file that this process may write [bytes]; None without a limit."""
    try:
        import resource
    except ImportError:  # a system without such limits
        return None
    soft = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return None if soft == resource.RLIM_INFINITY else soft


REMEDY = "Choose another folder, or free space there."  # Ends messages on failed writes.


def _to_mb(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
