"""Hidden names of files and folders during writing, and removal of files left by killed processes."""

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
"""Age [s] after which an unfinished file of another machine is removed; active runs write every few minutes."""


def remove_partial_files(
    folder: Path,
    name: str | None = None,
    max_age: float = STALE_SECONDS,
    is_kept: Callable[[str], bool] = lambda wanted: False,
) -> None:
    """Remove unfinished files in a folder: those of ended processes of this machine, and old ones of other machines.

    Parameters
    ----------
    name
        Name of the file whose unfinished versions are removed; None: all files.
    max_age
        Age at which unfinished files of other machines are removed [s].
    is_kept
        Function that returns True if the unfinished file for a name is kept, because a run may resume from it.
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
    """Return an identifier of 8 characters for this machine, since process numbers are valid only on one machine."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def to_unfinished_path(path: Path) -> Path:
    """Return the path of the unfinished work on `path`, from which a run resumes."""
    return path.with_name(path.name + ".partial")


def to_partial_path(path: Path) -> Path:
    """Return the hidden path at which this process writes the file or folder `path`; see `remove_partial_files`."""
    return path.with_name(f".sulcus-{_compute_host_id()}-{os.getpid()}-{path.name}")


def list_partials(path: Path) -> list[Path]:
    """Return the hidden paths at which any process of any machine writes `path` or has left it unfinished."""
    form = _build_name_pattern(path.name)
    return sorted(left for left in path.parent.glob(f".sulcus-*-{glob.escape(path.name)}") if form.fullmatch(left.name))


def _build_name_pattern(name: str | None) -> re.Pattern[str]:
    """Return the pattern of hidden names: machine, process, and final name; None: any final name."""
    return re.compile(rf"\.sulcus-([0-9a-f]{{8}})-(\d{{1,9}})-({'.+' if name is None else re.escape(name)})")


def _is_process_alive(process: int) -> bool:
    """Return True if a process with this number runs, or if this cannot be determined."""
    if os.name != "posix" or process == os.getpid():
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
