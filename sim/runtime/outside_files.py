"""Reading of files from outside: every failure becomes an error message of one sentence."""

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
"""Remedy for a file that another program has open."""

TRUNCATION_PATTERN = re.compile(r"truncated file: eof = (\d+),.* stored_eof = (\d+)")
"""Pattern of HDF5's message on a truncated file: its size, and the size it should have [bytes]."""


def to_path(path: object) -> Path:
    """Convert text or a path to a Path.

    Raises
    ------
    InputError
        Any other type.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{path!r} names no file: give its path as text, or as a pathlib.Path.")
    return Path(path)


@contextmanager
def wrap_errors(path: str | Path, kind: str, remedy: str) -> Iterator[None]:
    """Turn any exception of a block that reads `path` into an InputError of one sentence.

    Parameters
    ----------
    kind
        Expected kind of file, with its article: "a mesh".
    remedy
        Sentence with the remedy.

    Raises
    ------
    InputError
        Replaces every exception but an interruption; an InputError that already begins with the path is unchanged.
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
    """Parse a JSON file that states its `format`; call it in a block of `wrap_errors`.

    Raises
    ------
    InputError
        Another format than `version`.
    """
    stored = json.loads(path.read_text(encoding="utf-8-sig"))
    if stored.get("format") != version:
        raise InputError(f"its format is not {version!r}. {remedy}")
    return stored


def _describe_reason(error: BaseException) -> str:
    """Return the reason in plain words, not those of a library."""
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
