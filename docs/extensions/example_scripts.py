"""The scripts in examples/ as sphinx-gallery wants them: the docstring's first sentence, underlined, is the title."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from plain_docstrings import structured


def gallery_script(text: str) -> str:
    """The same script, whose docstring has a title: its first line up to a colon or to its full stop."""
    (head, *_) = ast.parse(text).body
    assert isinstance(head, ast.Expr) and isinstance(head.value, ast.Constant) and isinstance(head.value.value, str)
    words = head.value.value.strip()
    title = re.split(r":\s|\.(?:\s|$)", words, maxsplit=1)[0].replace("\n", " ")
    rest = words if words.startswith(f"{title}:") else words[len(title) :].lstrip(". \n")
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
        (target / script.name).write_text(gallery_script(script.read_text()))
