"""Folders that appear whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, demand_space, why


@contextmanager
def written_folder(path: Path, size: int) -> Iterator[Path]:
    """A folder beside `path` to write in, which takes its name when the block ends well, and is removed if not.

    `size` is how many bytes it will hold, about.

    Raises
    ------
    InputError
        A folder that is there and not empty, what a killed run left, a full disk, a place that cannot be written.
    """
    partial = path.with_name(f"{path.name}.partial")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path}: is there and not empty. Choose another name, or remove it.")
    if partial.exists():
        raise InputError(f"{partial}: another run writes it, or was killed. Where none does, remove it.")
    demand_space(path, size)
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
