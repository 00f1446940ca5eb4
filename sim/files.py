"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import InputError


def check_output(path: str | Path, suffix: str) -> Path:
    """The path of a file that can be written, its folder made; asked before long work, so that none is lost.

    Raises
    ------
    InputError
        A name that does not end in `suffix`, or a folder that cannot be written to.
    """
    path = Path(path)
    if path.suffix != suffix:
        raise InputError(f"{path}: this file is written as {suffix}; give a name that ends so.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: its folder cannot be made ({error.strerror}). Choose another folder.") from error
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: cannot be written there. Choose another name or folder.")
    return path


@contextmanager
def written_whole(path: str | Path, suffix: str) -> Iterator[Path]:
    """A name beside `path`, of the same ending, to write under; it takes the name `path` when the block ends well.

    Raises
    ------
    InputError
        As `check_output`; and where writing fails.
    """
    path = check_output(path, suffix)
    partial = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}). Choose another folder.") from error
    finally:
        partial.unlink(missing_ok=True)
