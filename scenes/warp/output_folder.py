"""The folder that a warp is written to: its files appear together, and no file of anybody else is replaced."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, check_output, partial_path, remove_left_overs, why

LISTED, FORMAT = "warp.json", "sulcus warp 1"
"""The file that lists all others, and what it says of itself."""


def own_files(folder: Path) -> set[str]:
    """Names of the files in a folder that an earlier warp wrote; none where nothing says so.

    What lists a path to elsewhere was written by nobody of us.
    """
    try:
        listed = json.loads((folder / LISTED).read_text())
        names = {LISTED, *map(str, listed["files"])} if listed["format"] == FORMAT else set()
    except (OSError, ValueError, LookupError, TypeError):
        return set()
    return names if all(Path(name).name == name for name in names) else set()


def claimed_warp(folder: Path, force: bool) -> Path:
    """A folder in which a warp can be written; nothing is left behind by asking.

    Raises
    ------
    InputError
        A file of that name; a place where nothing can be written; without `force`, a folder with other files.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, but a warp is a folder. Choose another name.")
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        check_output(folder / LISTED, ".json")
    finally:
        for each in missing:
            if each.is_dir():
                each.rmdir()
    if folder.exists() and not force:
        foreign = sorted({path.name for path in folder.iterdir()} - own_files(folder))
        if foreign:
            raise InputError(
                f"{folder}: holds {foreign[0]}, which no warp wrote. Choose another folder, or give --force to write "
                "beside it."
            )
    return folder


@contextmanager
def written_warp(folder: Path) -> Iterator[Path]:
    """A folder beside `folder` to write in; when the block ends well its files replace those of an earlier warp.

    Raises
    ------
    InputError
        A place that cannot be written, or is full.
    """
    partial = partial_path(folder)
    remove_left_overs(folder.parent, folder.name)
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        yield partial
        folder.mkdir(exist_ok=True)
        old = own_files(folder)
        new = [path.name for path in partial.iterdir()]
        for name in new:
            (partial / name).replace(folder / name)
        for name in old - set(new):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({why(error)}). {REMEDY}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
