"""A user's own Python file: run as it stands, with the rights of whoever runs it; a failure is stated in a sentence."""

from __future__ import annotations

import hashlib
import sys
import traceback
from pathlib import Path
from types import ModuleType

from ..errors import InputError


def run_script(path: str | Path) -> ModuleType:
    """Return the module that a Python file makes; modules beside the file can be imported from it.

    The same text at the same place is run once a process, so that its classes are the same for all who ask.

    Raises
    ------
    InputError
        A file that is missing, is no Python, or raises an exception: with its line.
    """
    path = Path(path).absolute()
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Name a Python file.") from error
    mark = hashlib.sha256(bytes(path) + b"\0" + text).hexdigest()[:12]
    name = f"own_{path.stem}_{mark}"
    if name in sys.modules:
        return sys.modules[name]
    try:
        code = compile(text, str(path), "exec", dont_inherit=True)
    except (SyntaxError, ValueError) as error:  # a null byte is a ValueError in some versions
        line = getattr(error, "lineno", None)
        where = f"{path}, line {line}" if line else f"{path}"
        raise InputError(f"{where}: is no Python ({getattr(error, 'msg', error)}). Mend the file.") from error
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module  # dataclasses and Warp look their module up
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)  # last: no file beside it stands in for a library's
    try:
        exec(code, module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise InputError(format_script_error(path, error)) from error
    except BaseException:
        del sys.modules[name]
        raise
    return module


def format_script_error(path: Path, error: BaseException) -> str:
    """What a user's file raised, and in which of its lines."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    where = f"{path}, line {lines[-1]}" if lines else str(path)
    if isinstance(error, InputError):
        return f"{where}: {error}"
    return f"{where}: raised {type(error).__name__}: {error}. Mend the file."
