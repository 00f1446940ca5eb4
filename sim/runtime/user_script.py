"""Execution of a Python file of the user, with the rights of the user; failures become errors of one sentence."""

import hashlib
import sys
import traceback
from pathlib import Path
from types import ModuleType

from ..errors import InputError


def run_script(path: str | Path) -> ModuleType:
    """Run a Python file and return its module; the file can import modules from its folder.

    The same text at the same path runs only once per process, so that all callers get the same classes.

    Raises
    ------
    InputError
        The file is missing, is not valid Python, or raises an exception; the message gives the line.
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
        raise InputError(f"{where}: is not valid Python ({getattr(error, 'msg', error)}). Correct the file.") from error
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module  # needed by dataclasses and Warp
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)  # last: a file next to it cannot replace a library
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
    """Return a description of the exception that a user's file raised, with the last line in this file."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    where = f"{path}, line {lines[-1]}" if lines else str(path)
    if isinstance(error, InputError):
        return f"{where}: {error}"
    return f"{where}: raised {type(error).__name__}: {error}. Correct the file."
