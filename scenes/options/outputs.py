"""Checks of output files before the work, for all commands; files derived from a mesh are next to the mesh.

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
    """Declare --force: shared by every command that writes."""
    parser.add_argument("--force", action="store_true", help="replace existing files")


def check_output_path(
    path: str | Path, suffix: str, force: bool = False, inputs: Sequence[str | Path | None] = (), resumed: bool = False
) -> Path:
    """Check that a file can be written and, unless `force`, does not exist; return its path without creating files.

    The command's `inputs` are never replaced. A file that the command resumes, `resumed`, may exist.

    Raises
    ------
    InputError
        See `check_output`; an input of the command; without `force`, an existing file.
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
    """Check that images can be written into a folder; return it and leave nothing behind. `content`: their plural name.

    Raises
    ------
    InputError
        A file of that name, or a place where nothing can be written.
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
    """List the frames in a folder, which `force` allows to remove; other files are kept.

    Raises
    ------
    InputError
        Existing frames, without `force`.
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
    """Read the attributes of a data set, an unfinished one, or a model file as texts; empty if unreadable."""
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
    """List data and models next to a mesh file that were made with an anatomy of another `digest`."""
    from ..play.deformers import to_model_path  # takes seconds, and is not needed for simulation alone

    data = mesh_path.with_suffix(".h5")
    beside = (data, to_unfinished_path(data), to_model_path(mesh_path))
    return [path for path in beside if path.is_file() and read_attributes(path).get("anatomy", digest) != digest]


def check_no_foreign_files(mesh_path: Path, digest: str, force: bool) -> list[Path]:
    """Return the files of `find_foreign_files`, which only `force` accepts.

    Raises
    ------
    InputError
        An existing file, without `force`.
    """
    found = find_foreign_files(mesh_path, digest)
    if found and not force:
        raise InputError(
            f"{mesh_path}: would replace the anatomy to which {' and '.join(path.name for path in found)} next to it "
            "belong. Repeat the first command, choose another --out, or give --force to replace them."
        )
    return found


def remove_outdated_data(path: Path, expected: Mapping[str, str]) -> None:
    """Remove a data set, complete or unfinished, whose attributes differ from `expected`; keep others."""
    for each in (path, to_unfinished_path(path)):
        found = read_attributes(each)
        if any(found.get(name) != expected.get(name) for name in UNCHANGED_ATTRIBUTES):
            each.unlink(missing_ok=True)


def read_batch_size(path: Path) -> int | None:
    """Return the batch size of an existing or unfinished data set, which it keeps; None if unreadable."""
    for each in (path, to_unfinished_path(path)):
        found = read_attributes(each).get("batch", "")
        if found.isdigit():
            return int(found)
    return None
