"""What is made before the pages are read: it lies in generated/, and is not edited."""

from __future__ import annotations

import re
from pathlib import Path

from array_tables import dataset_table, episode_table
from command_pages import command_pages
from example_scripts import copy_scripts
from plan_keys import plan_table
from public_names import reference_pages
from sphinx.application import Sphinx

HEADER = """Examples
========

Scripts from the folder ``examples/``. Each is short, and runs by ``python examples/NAME.py`` or as its page says.
"""
# Links that hold beside the repository's files, and what they become among the pages.
IN_PAGES = (
    (re.compile(r"\]\(\.\./((?:\.\./)*)examples/(\w+)\.py\)"), r"](\1generated/examples/\2.rst)"),
    (re.compile(r"\]\(\.\./((?:\.\./)*)examples/?\)"), r"](\1generated/examples/index.rst)"),
    (re.compile(r"\]\(\.\./((?:\.\./)*)CONTRIBUTING\.md\)"), r"](\1generated/contributing.md)"),
)


def setup(app: Sphinx) -> dict[str, bool]:
    """Make the pages before the gallery looks for its scripts."""
    app.connect("builder-inited", _make, priority=100)
    app.connect("source-read", _relinked)
    return {"parallel_read_safe": True}


def _make(app: Sphinx) -> None:
    source, made = Path(app.srcdir), Path(app.srcdir) / "generated"
    made.mkdir(exist_ok=True)
    pages = {
        **command_pages(),
        "dataset-arrays.txt": dataset_table(),
        "episode-arrays.txt": episode_table(),
        "plan-keys.txt": plan_table(),
        "changes.md": (source.parent / "CHANGELOG.md").read_text().replace("](docs/", "](../"),
        "contributing.md": (source.parent / "CONTRIBUTING.md").read_text().replace("](docs/", "](../"),
        **reference_pages(),
    }
    for name, text in pages.items():
        path = made / name
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text() != text:  # an unchanged page is not built again
            path.write_text(text)
    copy_scripts(source.parent / "examples", made / "scripts", HEADER)
    for folder in {(made / name).parent for name in pages}:
        _keep(folder, {name.rpartition("/")[2].partition(".")[0] for name in pages if (made / name).parent == folder})
    _keep(made / "examples", {"index", *(script.stem for script in (made / "scripts").glob("*.py"))})


def _keep(folder: Path, names: set[str]) -> None:
    """Take away files of other names, which earlier builds left: they would be pages that nothing leads to."""
    for path in folder.glob("*"):
        if path.is_file() and path.name.partition(".")[0] not in names:
            path.unlink()


def _relinked(app: Sphinx, name: str, text: list[str]) -> None:
    for link, page in IN_PAGES:
        text[0] = link.sub(page, text[0])
