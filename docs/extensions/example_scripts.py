"""The scripts in examples/ as sphinx-gallery wants them: an underlined title, and the image of docs/examples."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from plain_docstrings import structured


def gallery_script(text: str) -> str:
    """Return the script with a title in its docstring: the first paragraph up to a colon or a full stop.

    What a colon ends is said again below the title, where it begins a sentence.
    """
    head = ast.parse(text).body[0]
    words = ast.get_docstring(ast.Module([head], []))
    if not words:
        raise ValueError("an example begins with a docstring, whose first line is its title")
    first, _, _ = words.partition("\n\n")
    title, ended, _ = re.split(r"(:(?=\s)|\.(?=\s|$)|$)", first, maxsplit=1)[:3]
    rest = words if ended == ":" else words[len(title) + len(ended) :].lstrip()
    title = " ".join(title.split())
    body = "\n".join(structured(rest.splitlines()))
    code = "\n".join(text.splitlines()[head.end_lineno :])
    return f'r"""\n{title}\n{"=" * len(title)}\n\n{body}\n"""\n{code}\n'


def copy_scripts(source: Path, target: Path, header: str) -> None:
    """Write the gallery's scripts, and the words at its head, into a folder."""
    target.mkdir(parents=True, exist_ok=True)
    for old in target.iterdir():
        old.unlink()
    (target / "GALLERY_HEADER.rst").write_text(header)
    for script in sorted(source.glob("*.py")):
        image = f"# sphinx_gallery_thumbnail_path = 'examples/{script.stem}.webp'\n"
        (target / script.name).write_text(gallery_script(script.read_text()) + image)
