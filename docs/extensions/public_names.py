"""The reference of the public names: a page for each package, and one for each name in its `__all__`."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from enum import Enum
from pathlib import Path

from plain_docstrings import structured
from sphinx.pycode import ModuleAnalyzer
from topics import TOPICS

LONGEST = 200
"""Characters of a constant's value that is shown."""


def reference_pages() -> dict[str, str]:
    """Pages in reStructuredText by the place of their files."""
    pages = {}
    for package, topics in TOPICS.items():
        pages[f"{package}.rst"] = package_page(package)
        for name in " ".join(topics.values()).split():
            pages[f"{package}/{page_of(package, name)}.rst"] = name_page(package, name)
    return pages


def page_of(package: str, name: str) -> str:
    """File name of a name's page: functions get a suffix where case alone would distinguish two files."""
    names = [other.lower() for other in importlib.import_module(package).__all__]
    return f"{name}-function" if name.islower() and names.count(name.lower()) > 1 else name


def name_page(package: str, name: str) -> str:
    """Build the page of a name from its docstring."""
    title = f"{package}.{name}"
    return "\n".join([title, "=" * len(title), "", f".. currentmodule:: {package}", "", *_entry(package, name)])


def package_page(package: str) -> str:
    """Build the page of a package: its purpose, and tables of its names by topic.

    Raises
    ------
    ValueError
        Topics that miss a public name, or have one twice.
    """
    module, topics = importlib.import_module(package), TOPICS[package]
    named = sorted(" ".join(topics.values()).split())
    if named != sorted(module.__all__):
        raise ValueError(f"topics of {package} and its public names differ: {set(named) ^ set(module.__all__)}")
    lines = [package, "=" * len(package), "", f".. py:module:: {package}", f".. currentmodule:: {package}", ""]
    lines += [inspect.getdoc(module) or "", ""]
    for topic, names in topics.items():
        lines += [topic, "-" * len(topic), "", ".. list-table::", "   :widths: 30 70", ""]
        for name in names.split():
            lines += [f"   * - :py:obj:`{name}`", f"     - {_summary(package, name)}"]
        tree = (f"   {name} <{package}/{page_of(package, name)}>" for name in names.split())
        lines += ["", ".. toctree::", "   :hidden:", "", *tree, ""]
    return "\n".join(lines)


def _summary(package: str, name: str) -> str:
    """First sentence of a name's description."""
    found = getattr(importlib.import_module(package), name)
    known = inspect.isclass(found) or inspect.isfunction(found)
    words = structured((inspect.getdoc(found) or "").splitlines()) if known else _described(package, name)
    text = " ".join(line.strip() for line in "\n".join(words).partition("\n\n")[0].splitlines())
    return re.split(r"(?<=\.)\s", text, maxsplit=1)[0]


def _entry(package: str, name: str) -> list[str]:
    found = getattr(importlib.import_module(package), name)
    if inspect.isclass(found) and issubclass(found, Enum):
        return [f".. autoclass:: {name}", "   :members:", "   :undoc-members:", ""]
    if inspect.isclass(found):
        return [f".. autoclass:: {name}", "   :members:", ""]
    if inspect.isfunction(found):
        return [f".. autofunction:: {name}", ""]
    value = [f"   :value: {found!r}"] if len(repr(found)) < LONGEST else []
    return [f".. py:data:: {name}", *value, "", *(f"   {line}" for line in _described(package, name)), ""]


def _described(package: str, name: str) -> list[str]:
    """Return the docstring of a constant in the module from which the package's stub imports it."""
    stub = ast.parse(Path(str(importlib.import_module(package).__file__)).with_suffix(".pyi").read_text())
    (home,) = (
        node.module
        for node in stub.body
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}
    )
    analyzer = ModuleAnalyzer.for_module(f"{package}.{home}")
    analyzer.analyze()
    return structured(analyzer.attr_docs.get(("", name), []))
