"""Versions of installed packages, and this package's name on package indexes."""

import tomllib
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

DISTRIBUTION = "sulcus-ar"
"""The `name` in pyproject.toml: another project owns `sulcus` on the Python Package Index."""


@cache
def get_version(package: str) -> str:
    """Return the version of a package; "sulcus" is this one, which may be a checkout that is not installed."""
    if package != "sulcus":
        return version(package)
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        project = Path(__file__).parents[2] / "pyproject.toml"
        return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"]
