"""Hidden names of files and folders that are being written, and removal of those that killed processes left."""

from __future__ import annotations

import glob
import os
import platform
import re
import shutil
import time
import zlib
from collections.abc import Callable
from pathlib import Path

STALE = 24 * 3600.0
"""Another machine's unfinished file is a left-over after so long [s]: whoever writes, writes every few minutes."""


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


def _host() -> str:
    """Return a name of 8 characters for the machine: process numbers tell nothing of another's."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def to_unfinished_path(path: Path) -> Path:
    """Where a run that goes on keeps what it has done so far of `path`."""
    return path.with_name(path.name + ".partial")


def to_partial_path(path: Path) -> Path:
    """Return the hidden name under which this process writes `path`, a file or a folder.

    `remove_left_overs` knows it.
    """
    return path.with_name(f".sulcus-{_host()}-{os.getpid()}-{path.name}")


def list_partials(path: Path) -> list[Path]:
    """Return the hidden names under which any process of any machine writes `path`, or has left it unfinished."""
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
