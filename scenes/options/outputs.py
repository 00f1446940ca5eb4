"""Checks of what a command would write: before the work, for all commands in one place.

A file that is there is replaced by --force only. What resumes or extends its own output needs no --force.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import check_output, empty_parents_removed

FRAME = re.compile(r"frame_\d{4,}\.png")


def add_force(parser: argparse.ArgumentParser) -> None:
    """Declare --force: shared by every command that writes."""
    parser.add_argument("--force", action="store_true", help="replace files that are there")


def claimed(
    path: str | Path,
    suffix: str,
    force: bool = False,
    inputs: Sequence[str | Path | None] = (),
    resumed: bool = False,
) -> Path:
    """Path of a file that can be written, and is not there unless by `force`; nothing is left behind by asking.

    What the command reads, its `inputs`, is never replaced. A file that it goes on with, `resumed`, may be there.

    Raises
    ------
    InputError
        As `check_output`; a file that the command reads; without `force`, a file that is there.
    """
    with empty_parents_removed(Path(path)):
        path = check_output(path, suffix)
    if not path.exists():
        return path
    if any(one is not None and Path(one).exists() and path.samefile(one) for one in inputs):
        raise InputError(f"{path}: is what this command reads, and would be lost. Choose another name.")
    if not (force or resumed):
        raise InputError(f"{path}: exists. Give --force to replace it, or choose another name.")
    return path


def claimed_folder(folder: Path, what: str) -> Path:
    """Folder in which pictures can be written; nothing is left behind by asking. `what` names them in the plural.

    Raises
    ------
    InputError
        A file of that name, or a place where nothing can be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, but the {what} need a folder. Choose another name.")
    try:
        with empty_parents_removed(folder / "any.png"):
            check_output(folder / "any.png", ".png")
    except InputError as error:
        raise InputError(f"{folder}: the {what} cannot be written there. Choose another folder.") from error
    return folder


def claimed_frames(folder: Path, force: bool) -> list[Path]:
    """Frames that are in a folder, which `force` allows to remove; other files are left alone.

    Raises
    ------
    InputError
        Without `force`, where there are frames.
    """
    frames = sorted(path for path in folder.glob("frame_*.png") if FRAME.fullmatch(path.name))
    if frames and not force:
        raise InputError(
            f"{folder}: holds {len(frames)} frames. Give --force to remove them, or choose another folder."
        )
    return frames
