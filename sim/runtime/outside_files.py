"""Reading of files from the user: every failure becomes an error message of one sentence."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError

LOCK_REMEDY = "Close it there, then give the same command again."
"""Text of the remedy for a file that another program has open."""

TRUNCATION_PATTERN = re.compile(r"truncated file: eof = (\d+),.* stored_eof = (\d+)")
"""Pattern of the HDF5 message on a truncated file: actual size, and expected size [bytes]."""


def to_path(path: object) -> Path:
    """Return a text or a path as a `Path`.

    Raises
    ------
    InputError
        `path` is of another type.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{path!r} names no file: give its path as text, or as a pathlib.Path.")
    return Path(path)


@contextmanager
def wrap_errors(path: str | Path, kind: str, remedy: str) -> Iterator[None]:
    """Convert any exception of a block that reads `path` to an InputError of one sentence.

    Parameters
    ----------
    kind
        Expected kind of file, with its article, such as "a mesh".
    remedy
        Sentence with the remedy.

    Raises
    ------
    InputError
        Any exception except an interruption occurs; an InputError that already begins with the path is not changed.
    """
    try:
        with np.errstate(all="ignore"):  # damaged numbers
            yield
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: {error}") from error
    except BlockingIOError as error:
        raise InputError(f"{path}: is locked: another program has it open for writing. {LOCK_REMEDY}") from error
    except (Exception, SystemExit) as error:  # a damaged file may cause any exception
        raise InputError(f"{path}: cannot be read as {kind}: {_describe_reason(error)}. {remedy}") from error


def parse_json(path: Path, version: str, remedy: str) -> Any:
    """Return the content of a JSON file with an entry `format`; call this in a block of `wrap_errors`.

    Raises
    ------
    InputError
        The format is not `version`.
    """
    stored = json.loads(path.read_text(encoding="utf-8-sig"))
    if stored.get("format") != version:
        raise InputError(f"its format is not {version!r}. {remedy}")
    return stored


def _describe_reason(error: BaseException) -> str:
    """Return the reason of an error in plain words, not in those of a library."""
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
        case OSError() if found := TRUNCATION_PATTERN.search(str(error)):
            return f"it is cut off: {found[1]} of {found[2]} bytes"
    return "it is damaged, or of another kind"
