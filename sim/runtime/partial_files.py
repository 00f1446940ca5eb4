"""Hidden names of files and folders during writing, and removal of those left by killed processes."""

import glob
import os
import platform
import re
import shutil
import time
import zlib
from collections.abc import Callable
from pathlib import Path

STALE_SECONDS = 24 * 3600.0
"""Age [s] after which another machine's unfinished file is a left-over: active runs write every few minutes."""


def remove_partial_files(
    folder: Path,
    name: str | None = None,
    max_age: float = STALE_SECONDS,
    is_kept: Callable[[str], bool] = lambda wanted: False,
) -> None:
    """Remove unfinished files of dead processes of this machine in a folder, and old ones of other machines.

    Parameters
    ----------
    name
        Name of the file whose left-overs are removed; None: all files.
    max_age
        Age at which those of other machines are removed [s].
    is_kept
        Function that returns True if the unfinished file for a name stays, because a run may resume from it.
    """
    form = _build_name_pattern(name)
    try:
        for left in list(folder.iterdir()):
            found = form.fullmatch(left.name)
            if found is None or is_kept(found[3]):
                continue
            dead = (
                not _is_process_alive(int(found[2]))
                if found[1] == _compute_host_id()
                else time.time() - left.stat().st_mtime > max_age
            )
            if dead and left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            elif dead:
                left.unlink(missing_ok=True)
    except OSError:  # removal is optional: missing permissions do not stop the work
        return


def _compute_host_id() -> str:
    """Return an identifier of 8 characters for the machine: process numbers are valid on one machine only."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def to_unfinished_path(path: Path) -> Path:
    """Return the path of the unfinished work on `path`, from which a run resumes."""
    return path.with_name(path.name + ".partial")


def to_partial_path(path: Path) -> Path:
    """Return the hidden name under which this process writes `path`, a file or a folder; see `remove_partial_files`."""
    return path.with_name(f".sulcus-{_compute_host_id()}-{os.getpid()}-{path.name}")


def list_partials(path: Path) -> list[Path]:
    """List the hidden names under which any process of any machine writes `path`, or has left it unfinished."""
    form = _build_name_pattern(path.name)
    return sorted(left for left in path.parent.glob(f".sulcus-*-{glob.escape(path.name)}") if form.fullmatch(left.name))


def _build_name_pattern(name: str | None) -> re.Pattern[str]:
    """Build the pattern of hidden names: machine, process, and final name; None: any name."""
    return re.compile(rf"\.sulcus-([0-9a-f]{{8}})-(\d{{1,9}})-({'.+' if name is None else re.escape(name)})")


def _is_process_alive(process: int) -> bool:
    """Return True if a process with this number runs, or if that cannot be determined."""
    if os.name != "posix" or process == os.getpid():
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
