"""Files that come from outside: whatever is wrong with them is said in one sentence of ours."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import InputError

LOCKED = "Close it there, then give the same command again."
"""What to do about a file that another program holds."""

CUT_OFF = re.compile(r"truncated file: eof = (\d+),.* stored_eof = (\d+)")
"""What HDF5 says of a file that ends too early: how many bytes it has, and should have."""


def to_path(path: object) -> Path:
    """What names a file.

    Raises
    ------
    InputError
        Anything but text or a path.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{path!r} names no file: give its path as text, or as a pathlib.Path.")
    return Path(path)


@contextmanager
def read_as(path: str | Path, kind: str, remedy: str) -> Iterator[None]:
    """Turn whatever a block raises while it reads `path` into a sentence.

    Parameters
    ----------
    kind
        What the file should be, with its article: "a mesh".
    remedy
        A sentence that says what to do.

    Raises
    ------
    InputError
        In place of every exception but an interruption; those that are sentences already begin with the path.
    """
    try:
        with np.errstate(all="ignore"):  # of numbers that damage made
            yield
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: {error}") from error
    except BlockingIOError as error:
        raise InputError(f"{path}: is locked: another program has it open for writing. {LOCKED}") from error
    except (Exception, SystemExit) as error:  # a damaged byte leads a library to raise anything, or to exit
        raise InputError(f"{path}: cannot be read as {kind}: {_reason(error)}. {remedy}") from error


def _reason(error: BaseException) -> str:
    """Why, in words that are not a library's."""
    match error:
        case MemoryError():
            return "it asks for more memory than there is"
        case RecursionError():
            return "its text is nested too deeply"
        case OSError(errno=int(number)) if number > 0:
            return os.strerror(number)[0].lower() + os.strerror(number)[1:]
        case UnicodeDecodeError():
            return "it is no text in UTF-8"
        case EOFError():
            return "it ends too early"
        case OSError() if found := CUT_OFF.search(str(error)):
            return f"it is cut off: {found[1]} of {found[2]} bytes"
    return "it is damaged, or of another kind"
