"""What goes along with episodes into other formats: the data sheet and the licence of their folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ..reading.contents import LONGEST_TEXT, Contents

SHEET, LICENCE = "DATASHEET.md", "LICENSE.md"
"""Their names."""


def texts_along(episodes: Sequence[Contents]) -> Mapping[str, str]:
    """The texts by the names that they go by; those of several folders are numbered. None where there are none."""
    homes = dict.fromkeys(home_of(one.path.resolve().parent) for one in episodes)
    found = {}
    for number, home in enumerate(homes):
        for path in (home / SHEET, home / LICENCE):
            if path.is_file() and not path.is_symlink() and path.stat().st_size <= LONGEST_TEXT:
                name = path.name if len(homes) == 1 else f"{path.stem}_{number}{path.suffix}"
                found[name] = path.read_text(encoding="utf-8", errors="replace")
    return found


def write_along(episodes: Sequence[Contents], folder: Path) -> None:
    """Write the texts into a folder."""
    for name, text in texts_along(episodes).items():
        (folder / name).write_text(text, encoding="utf-8")


def home_of(folder: Path) -> Path:
    """The data set's folder, of that which its episodes lie in."""
    return folder.parent if folder.name == "episodes" and not (folder / LICENCE).exists() else folder
