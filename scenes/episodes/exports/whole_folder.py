"""Folders that appear whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, demand_space, partial_path, remove_left_overs, why


@contextmanager
def written_folder(path: Path, size: int) -> Iterator[Path]:
    """A folder beside `path` to write in, which takes its name when the block ends well, and is removed if not.

    `size` is how many bytes it will hold, about. What a killed run left of the same folder is removed.

    Raises
    ------
    InputError
        A folder that is there and not empty, a full disk, a place that cannot be written.
    """
    partial = partial_path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path}: is there and not empty. Choose another name, or remove it.")
    remove_left_overs(path.parent, path.name)
    demand_space(path, size)
    shutil.rmtree(partial, ignore_errors=True)  # of a dead process that had the same number
    try:
        partial.mkdir(parents=True)
        yield partial
        if path.exists():
            path.rmdir()
        partial.rename(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({why(error)}). {REMEDY}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
