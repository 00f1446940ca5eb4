"""Versions of installed packages, and the name under which package indexes know this one."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ..errors import InputError

DISTRIBUTION = "sulcus-ar"
"""The `name` in pyproject.toml: another project owns `sulcus` on the Python Package Index."""


def install_hint(extra: str) -> str:
    """Sentence that says how to install an extra of this package: from its checkout, as no index has it."""
    return f"Install it in the checkout: pip install -e '.[{extra}]'."


@contextmanager
def needed_from(extra: str, what: str) -> Iterator[None]:
    """Import packages of an extra in a block, for `what` needs them: "these environments need".

    Raises
    ------
    InputError
        In place of ModuleNotFoundError: which package is not installed, and how to install the extra.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        raise InputError(f"{what} the package {package}, which is not installed. {install_hint(extra)}") from error


@cache
def version_of(package: str) -> str:
    """Version of a package; "sulcus" is this one, which may be a checkout that is not installed."""
    if package != "sulcus":
        return version(package)
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        project = Path(__file__).parents[2] / "pyproject.toml"
        return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"]
