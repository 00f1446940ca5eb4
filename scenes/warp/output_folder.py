"""The folder that a warp is written to: its files appear together, and no file of anybody else is replaced."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, check_output, partial_path, partials_of, remove_left_overs, why

LISTED, FORMAT = "warp.json", "sulcus warp 1"
"""The file that lists all others, and what it says of itself. A folder without it holds no whole warp."""
UNFINISHED = "warp.unfinished.json"
"""Its place while files are replaced: it lists those of the earlier warp and of the new one."""


def own_files(folder: Path) -> set[str]:
    """Names of the files in a folder that an earlier warp wrote; none where nothing says so.

    What lists a path to elsewhere was written by nobody of us.
    """
    found: set[str] = set()
    for lister in (LISTED, UNFINISHED):
        with suppress(OSError, ValueError, LookupError, TypeError):
            listed = json.loads((folder / lister).read_text())
            names = {lister, *map(str, listed["files"])} if listed["format"] == FORMAT else set()
            found |= names if all(Path(name).name == name for name in names) else set()
    return found


@contextmanager
def written_warp(folder: Path, force: bool = False) -> Iterator[Path]:
    """Yield a hidden folder next to `folder`; when the block ends well, its files replace those of an earlier warp.

    The hidden folder keeps other runs out of `folder` until the block ends. If the process is killed while files are
    replaced, `warp.json` is missing, and the next run removes what this one wrote.

    Raises
    ------
    InputError
        A file of that name; a place that cannot be written, or is full; another run that writes there; without
        `force`, a folder with files that no warp wrote.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, but a warp is a folder. Choose another name.")
    target = folder.resolve()
    missing = [each for each in target.parents if not each.exists()]
    try:
        if target.exists():
            check_output(target / LISTED, ".json")
        with _alone(target):
            _demand_own(target, force)
            yield partial_path(target)
            _replace(partial_path(target), target)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({why(error)}). {REMEDY}") from error
    finally:
        for each in missing:  # only those that stayed empty
            with suppress(OSError):
                each.rmdir()


@contextmanager
def _alone(target: Path) -> Iterator[None]:
    """Make the hidden folder of `target`, and remove it in the end; rejected where another run has one."""
    partial = partial_path(target)
    remove_left_overs(target.parent, target.name)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        others = [left for left in partials_of(target) if left != partial]
        if others:
            raise InputError(
                f"{target}: another `sulcus warp` is writing there, in {others[0].name}. Wait for it or choose another "
                "--out; if no run is at work, remove that folder."
            )
        yield
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _demand_own(folder: Path, force: bool) -> None:
    foreign = sorted({path.name for path in folder.iterdir()} - own_files(folder)) if folder.exists() else []
    if foreign and not force:
        raise InputError(
            f"{folder}: holds {foreign[0]}, which no warp wrote. Choose another folder, or give --force to write "
            "beside it."
        )


def _replace(partial: Path, folder: Path) -> None:
    """Move the files of one folder into another, in an order in which a kill leaves no mixture that seems whole."""
    old, new = own_files(folder), {path.name for path in partial.iterdir()}
    folder.mkdir(exist_ok=True)
    unfinished = partial / UNFINISHED
    unfinished.write_text(json.dumps({"format": FORMAT, "files": sorted(old | new)}))
    unfinished.replace(folder / UNFINISHED)
    (folder / LISTED).unlink(missing_ok=True)
    for name in old - new - {UNFINISHED}:
        (folder / name).unlink(missing_ok=True)
    for name in sorted(new, key=lambda name: name == LISTED):  # the list comes last
        (partial / name).replace(folder / name)
    (folder / UNFINISHED).unlink()
