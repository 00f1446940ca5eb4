"""Solved loads of an unfinished body, which the next process that makes this body reuses.

Each process makes a body in its own hidden folder, and copies solved loads of other processes for the same body. No
locks are needed, because records of loads have checksums (`sim.runtime.journal`) even while they are written.
"""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from sim.runtime.atomic_files import write_atomically
from sim.runtime.partial_files import to_unfinished_path

DATA = "training.h5"
"""File name of the training loads of a body's model, which exist until training ends."""
NOTE, TABLE = ".json", ".series.npz"
"""Endings of companion files: description of the loads, and power-series table if the model type has a table."""


def resume_data_set(path: Path, inputs: Mapping[str, str], other_folders: Sequence[Path]) -> bool:
    """Resume a data set and its power-series table from the most complete copy; return True if there is a copy.

    Copies are searched in the data set's own folder and in `other_folders`.

    Parameters
    ----------
    inputs
        All inputs that determine the bytes of the data set; copies with other inputs are ignored.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    said = json.dumps(dict(inputs), sort_keys=True)
    if not _has_inputs(path, said):
        remove_data_set(path)
        with write_atomically(path.with_suffix(NOTE), NOTE, remove_partials=False) as partial:
            partial.write_text(said, encoding="utf-8")
    alike = [path, *(each for other in other_folders if _has_inputs(each := other / path.name, said))]
    *_, (whole, size, best) = sorted(max(_find_kept_files(each), default=(False, 0, each)) for each in alike)
    if size:
        _copy(best, path if whole else to_unfinished_path(path))
    for table in (each.with_suffix(TABLE) for each in alike):
        if table.exists() and not path.with_suffix(TABLE).exists():
            _copy(table, path.with_suffix(TABLE))
    return has_solved_loads(path.parent)


def _copy(source: Path, target: Path) -> None:
    if source == target:
        return
    with (
        suppress(FileNotFoundError),  # from a process that has finished with it
        source.open("rb") as file,
        write_atomically(target, target.suffix, remove_partials=False) as partial,
        partial.open("wb") as copy,
    ):
        shutil.copyfileobj(file, copy)


def has_solved_loads(folder: Path) -> bool:
    """Return True if the folder of a body contains solved loads."""
    return any(path.exists() for path in _list_files(folder / DATA)[1:])


def clear_folder(folder: Path) -> None:
    """Create a folder, or remove all files of an existing folder except solved loads of a body."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in set(folder.iterdir()) - set(_list_files(folder / DATA)):
        path.unlink()


def remove_data_set(data: Path) -> None:
    """Remove a complete or unfinished data set, with its description and its power-series table."""
    for path in _list_files(data):
        path.unlink(missing_ok=True)


def _list_files(data: Path) -> tuple[Path, ...]:
    """Return the paths of description, unfinished data set, complete data set, and power-series table."""
    return data.with_suffix(NOTE), to_unfinished_path(data), data, data.with_suffix(TABLE)


def _has_inputs(data: Path, inputs: str) -> bool:
    with suppress(OSError, ValueError):
        return data.with_suffix(NOTE).read_text(encoding="utf-8") == inputs
    return False


def _find_kept_files(data: Path) -> Iterator[tuple[bool, int, Path]]:
    """Yield for each existing file of a data set: True if complete, size [bytes], path."""
    for path in (data, to_unfinished_path(data)):
        with suppress(OSError):
            yield path == data, path.stat().st_size, path
