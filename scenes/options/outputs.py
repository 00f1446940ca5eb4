"""Checks of output files before the computation, for all commands.

An existing file is replaced only with --force. Commands that resume or extend their own output need no --force.
"""

import argparse
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import check_output, remove_empty_parents
from sim.runtime.journal import read_description
from sim.runtime.partial_files import to_unfinished_path

FRAME_PATTERN = re.compile(r"frame_\d{4,}\.png")  # Pattern of a frame's file name.


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add the option --force of commands that write files to a parser."""
    parser.add_argument("--force", action="store_true", help="replace existing files")


def check_output_path(
    path: str | Path, suffix: str, force: bool = False, inputs: Sequence[str | Path | None] = (), resumed: bool = False
) -> Path:
    """Check that a file can be written, and does not exist unless `force`; return its path without creating files.

    If `resumed`, the command resumes the file, which may then exist. The command's `inputs` are never replaced.

    Raises
    ------
    InputError
        See `check_output`; the file is an input of the command; the file exists, and neither `force` nor `resumed`.
    """
    with remove_empty_parents(Path(path)):
        path = check_output(path, suffix)
    if not path.exists():
        return path
    if any(one is not None and Path(one).exists() and path.samefile(one) for one in inputs):
        raise InputError(f"{path}: is what this command reads, and would be lost. Choose another name.")
    if not (force or resumed):
        raise InputError(f"{path}: exists. Give --force to replace it, or choose another name.")
    return path


def check_output_folder(folder: Path, content: str) -> Path:
    """Check that files can be written into a folder, and return it; `content` is the files' plural name in messages.

    Raises
    ------
    InputError
        The path is a file, or the folder is not writable.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, but the {content} need a folder. Choose another name.")
    try:
        with remove_empty_parents(folder / "any.png"):
            check_output(folder / "any.png", ".png")
    except InputError as error:
        raise InputError(f"{folder}: the {content} cannot be written there. Choose another folder.") from error
    return folder


def check_output_frames(folder: Path, force: bool) -> list[Path]:
    """List the frame images in a folder, which the caller may remove only if `force`.

    Raises
    ------
    InputError
        The folder contains frames, and `force` is False.
    """
    frames = sorted(path for path in folder.glob("frame_*.png") if FRAME_PATTERN.fullmatch(path.name))
    if frames and not force:
        raise InputError(
            f"{folder}: holds {len(frames)} frames. Give --force to remove them, or choose another folder."
        )
    return frames


# Attributes of a data set that must be unchanged for a run to resume it.
UNCHANGED_ATTRIBUTES = ("anatomy", "effects", "tissue", "element", "accuracy", "preset", "seed", "shape")


def read_attributes(path: Path) -> dict[str, str]:
    """Read the attributes of a complete or unfinished data set, or of a model file, as texts; empty if unreadable."""
    import h5py

    from surrogate.model.npz_archive import Archive

    try:
        if path.suffix == ".npz":
            with path.open("rb") as raw:
                return {name: str(value) for name, value in json.loads(Archive(raw).read_text("header")).items()}
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                return {name: str(value) for name, value in file.attrs.items()}
        return read_description(path)
    except (OSError, ValueError, LookupError, AttributeError, zipfile.BadZipFile):
        return {}


def find_foreign_files(mesh_path: Path, digest: str) -> list[Path]:
    """List the data sets and models next to a mesh file that belong to an anatomy with another digest."""
    from ..play.deformers import to_model_path  # takes seconds, and is not needed for simulation alone

    data = mesh_path.with_suffix(".h5")
    beside = (data, to_unfinished_path(data), to_model_path(mesh_path))
    return [path for path in beside if path.is_file() and read_attributes(path).get("anatomy", digest) != digest]


def check_no_foreign_files(mesh_path: Path, digest: str, force: bool) -> list[Path]:
    """Return the files of `find_foreign_files`; there may be such files only if `force`.

    Raises
    ------
    InputError
        There is such a file, and `force` is False.
    """
    found = find_foreign_files(mesh_path, digest)
    if found and not force:
        raise InputError(
            f"{mesh_path}: would replace the anatomy to which {' and '.join(path.name for path in found)} next to it "
            "belong. Repeat the first command, choose another --out, or give --force to replace them."
        )
    return found


def remove_outdated_data(path: Path, expected_attributes: Mapping[str, str]) -> None:
    """Remove a complete or unfinished data set if its attributes differ from `expected_attributes`."""
    for each in (path, to_unfinished_path(path)):
        found = read_attributes(each)
        if any(found.get(name) != expected_attributes.get(name) for name in UNCHANGED_ATTRIBUTES):
            each.unlink(missing_ok=True)


def read_batch_size(path: Path) -> int | None:
    """Return the batch size of a complete or unfinished data set; None if it is not available."""
    for each in (path, to_unfinished_path(path)):
        found = read_attributes(each).get("batch", "")
        if found.isdigit():
            return int(found)
    return None
