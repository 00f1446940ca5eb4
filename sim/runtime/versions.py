"""Versions of installed packages, and the name of this package on package indexes."""

import tomllib
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

DISTRIBUTION = "sulcus-ar"
"""Name in pyproject.toml; on the Python Package Index, `sulcus` belongs to another project."""


@cache
def get_version(package: str) -> str:
    """Return the version of a package; "sulcus" is this package, which may be a checkout that is not installed."""
    if package != "sulcus":
        return version(package)
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        project = Path(__file__).parents[2] / "pyproject.toml"
        return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"]
