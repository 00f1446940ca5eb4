"""The house's docstrings are plain text with numpydoc's sections and `names` in backticks: here they become markup."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config
from sphinx.ext.napoleon.docstring import NumpyDocstring

SECTIONS: Any = Config(napoleon_use_rtype=False)

NAME = re.compile(r"(``.+?``|`[^`]+`)")
MARK = re.compile(r"[*|\\]|(?<=\w)_(?!\w)")
"""What begins emphasis, a substitution or an escape, or ends a link."""
CLINGING = re.compile(r"\A[\w(\[]")
"""What may not follow a name's last backtick at once."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Read docstrings as autodoc finds them."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-docstring", _each)
    return {"parallel_read_safe": True}


def _each(app: Sphinx, kind: Any, name: str, member: object, settings: object, lines: list[str]) -> None:
    # Of a property napoleon would take what stands before a colon for its type.
    lines[:] = NumpyDocstring(structured(lines), SECTIONS, what="method" if kind == "property" else kind).lines()


def structured(lines: Sequence[str]) -> list[str]:
    """Convert text to reStructuredText: marks are escaped, indented formulas and doctests keep their shape."""
    found: list[str] = []
    plain: list[str] = []
    inside = described = shown = False
    for number, line in enumerate(lines):
        inset, empty = line.startswith("    "), not line.strip()
        # Below the underline of a section, inset lines describe parameters.
        described = described or set(line.strip()) == {"-"}
        if inset and not inside and not described and (not number or not lines[number - 1].strip()):
            found += [*_unmarked(plain), "::", ""]
            plain, inside = [], True
        inside = inside and (inset or empty)
        shown = (shown or line.startswith(">>>")) and not empty
        if shown:
            found += _unmarked(plain)
            plain = []
        (found if inside or shown else plain).append(line)
    return found + _unmarked(plain)


def _unmarked(lines: Sequence[str]) -> list[str]:
    """Lines whose marks are escaped outside of names, which may go on from one line to the next."""
    parts = NAME.split("\n".join(lines))
    for number in range(0, len(parts), 2):
        text = MARK.sub(r"\\\g<0>", parts[number])
        parts[number] = CLINGING.sub(r"\\ \g<0>", text) if number else text
    return "".join(parts).split("\n") if lines else []
