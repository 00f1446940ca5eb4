"""Folder in which Warp compiles kernels: a private temporary folder if the default folder is not writable."""

import os
import stat
import sys
import warnings
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryFile, gettempdir, mkdtemp

from ..errors import InputError

CACHE_VARIABLE = "WARP_CACHE_PATH"  # Environment variable with Warp's folder.
FOLDER_PREFIX = "sulcus-kernels"  # Prefix of the temporary folder.
REMEDY = f"Set {CACHE_VARIABLE} to a folder that can be written."  # Ends the messages below.


def ensure_writable_cache() -> None:
    """Set `WARP_CACHE_PATH` to a private temporary folder, with a warning, if the default of Warp is not writable.

    Child processes inherit this variable. Warp reads the variable when it is first used.

    Raises
    ------
    InputError
        No temporary folder is writable either.
    """
    usual = _get_default_folder()
    if _is_writable(usual):
        return
    try:
        folder = _create_private_folder()
    except OSError as error:
        raise InputError(f"{usual}: kernels cannot be compiled there, nor in a temporary folder. {REMEDY}") from error
    os.environ[CACHE_VARIABLE] = str(folder)
    warnings.warn(f"{usual} cannot be written: kernels are compiled into {folder}. {REMEDY}", stacklevel=1)


def _get_default_folder() -> Path:
    """Return the default cache folder of Warp."""
    number = version("warp-lang")
    if chosen := os.environ.get(CACHE_VARIABLE):
        return Path(chosen).absolute() / number
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", "~")).expanduser() / "NVIDIA" / "warp" / "Cache" / number
    if sys.platform == "darwin":
        return Path(os.path.expanduser("~/Library/Caches")) / "warp" / number
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "warp" / number


def _is_writable(folder: Path) -> bool:
    """Return True if a file can be written in a folder, which is created if necessary; False without a home folder."""
    try:
        if not folder.is_absolute():
            return False
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder) as file:
            file.write(b"0")
    except OSError:
        return False
    return True


def _create_private_folder() -> Path:
    """Return a created folder that only this user can access; later runs use the same folder if its name is free.

    Raises
    ------
    OSError
        No folder can be created.
    """
    own = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(gettempdir()) / f"{FOLDER_PREFIX}-{own}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    private = sys.platform == "win32" or (found.st_uid == own and stat.S_IMODE(found.st_mode) == 0o700)
    if stat.S_ISDIR(found.st_mode) and private and _is_writable(folder):
        return folder
    return Path(mkdtemp(prefix=f"{FOLDER_PREFIX}-"))
