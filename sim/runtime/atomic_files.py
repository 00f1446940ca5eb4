"""Files that appear whole or not at all."""

from __future__ import annotations

import glob
import os
import platform
import re
import shutil
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError


def why(error: OSError) -> str:
    """Why a file cannot be had, in the system's own words and not a library's."""
    return os.strerror(error.errno) if error.errno else "the library that writes it failed"


STALE = 24 * 3600.0
"""Another machine's unfinished file is a left-over after so long [s]: whoever writes, writes every few minutes."""


def check_output(path: str | Path, suffix: str, stale: float = STALE, sweep: bool = True) -> Path:
    """The path of a file that can be written, its folder made; asked before long work, so that none is lost.

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
        raise InputError(f"{path}: its folder cannot be made ({why(error)}). Choose another folder.") from error
    if path.is_dir():
        raise InputError(f"{path}: cannot be written, it is a folder. Choose another name.")
    if sweep:
        remove_left_overs(path.parent, path.name, stale)
    probe = partial_path(path)
    try:  # permissions alone do not tell: a file system may be read-only, or make no files
        probe.touch()
    except OSError as error:
        raise InputError(f"{path}: cannot be written there ({why(error)}). Choose another folder.") from error
    finally:
        probe.unlink(missing_ok=True)
    return path


def remove_left_overs(
    folder: Path,
    name: str | None = None,
    stale: float = STALE,
    kept: Callable[[str], bool] = lambda wanted: False,
) -> None:
    """Remove what dead processes of this machine left unfinished in a folder, and what others have not touched lately.

    Parameters
    ----------
    name
        Of the file whose left-overs are meant; None means all files.
    stale
        How long others need not have touched theirs [s].
    kept
        Whether what was to become the file of a name stays all the same, as somebody may go on with it.
    """
    form = _partial_form(name)
    try:
        for left in list(folder.iterdir()):
            found = form.fullmatch(left.name)
            if found is None or kept(found[3]):
                continue
            dead = not _alive(int(found[2])) if found[1] == _host() else time.time() - left.stat().st_mtime > stale
            if dead and left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            elif dead:
                left.unlink(missing_ok=True)
    except OSError:  # a folder that may not be listed, or a left-over that may not be removed, stops no work
        return


@contextmanager
def written_whole(path: str | Path, suffix: str, sweep: bool = True) -> Iterator[Path]:
    """A name beside `path`, of the same ending, to write under; it takes the name `path` when the block ends well.

    `sweep` is that of `check_output`.

    Raises
    ------
    InputError
        As `check_output`; and where writing fails.
    """
    path = check_output(path, suffix, sweep=sweep)
    partial = partial_path(path)
    try:
        yield partial
        with partial.open("rb") as file:  # whole on the disk, before it takes a name that says so
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({why(error)}). {REMEDY}") from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def written_stream(path: str | Path, suffix: str, sweep: bool = True) -> Iterator[Stream]:
    """As `written_whole`, but an open binary file; for HDF5, which ends the process where a write of its own fails.

    Raises
    ------
    InputError
        As `written_whole`.
    """
    with written_whole(path, suffix, sweep) as partial, partial.open("w+b", buffering=0) as raw:
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
        """The place."""
        return self._raw.tell()

    def flush(self) -> None:
        """Nothing: no byte waits."""


def demand_space(path: str | Path, size: int, largest: int | None = None) -> None:
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


def _host() -> str:
    """A name of 8 characters for the machine: process numbers tell nothing of another's."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def unfinished_path(path: Path) -> Path:
    """Where a run that goes on keeps what it has done so far of `path`."""
    return path.with_name(path.name + ".partial")


def partial_path(path: Path) -> Path:
    """The hidden name under which this process writes `path`, a file or a folder; `remove_left_overs` knows it."""
    return path.with_name(f".sulcus-{_host()}-{os.getpid()}-{path.name}")


def partials_of(path: Path) -> list[Path]:
    """The hidden names under which any process of any machine writes `path`, or has left it unfinished."""
    form = _partial_form(path.name)
    return sorted(left for left in path.parent.glob(f".sulcus-*-{glob.escape(path.name)}") if form.fullmatch(left.name))


def _partial_form(name: str | None) -> re.Pattern[str]:
    """Of hidden names: machine, process, and the name that is to be; None: any."""
    return re.compile(rf"\.sulcus-([0-9a-f]{{8}})-(\d{{1,9}})-({'.+' if name is None else re.escape(name)})")


def _alive(process: int) -> bool:
    """Whether a process of this number runs; where that cannot be found out, it may."""
    if os.name != "posix" or process == os.getpid():
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
