"""What ships with the package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def template_path() -> Path:
    """The template anatomy, a .vtu; its scan and its models lie beside it."""
    return Path(str(files("scenes"))) / "data" / "template.vtu"
