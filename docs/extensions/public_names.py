"""The reference of the public names: a page for each package, and one for each name in its `__all__`."""

from __future__ import annotations

import ast
import importlib
import inspect
from enum import Enum
from pathlib import Path

from plain_docstrings import structured
from sphinx.pycode import ModuleAnalyzer

PACKAGES = ("sim", "surrogate", "ar", "scenes")
LONGEST = 200
"""Characters of a constant's value that is shown."""


def reference_pages() -> dict[str, str]:
    """Pages in reStructuredText by the place of their files."""
    packages = {package: importlib.import_module(package).__all__ for package in PACKAGES}
    names = {f"{package}/{name}.rst": name_page(package, name) for package, known in packages.items() for name in known}
    return {f"{package}.rst": package_page(package) for package in packages} | names


def name_page(package: str, name: str) -> str:
    """What a name is, from its docstring."""
    title = f"{package}.{name}"
    return "\n".join([title, "=" * len(title), "", f".. currentmodule:: {package}", "", *_entry(package, name)])


def package_page(package: str) -> str:
    """What the package is, and a table of its names."""
    names = importlib.import_module(package).__all__
    return "\n".join(
        [
            package,
            "=" * len(package),
            "",
            f".. py:module:: {package}",
            f".. currentmodule:: {package}",
            "",
            inspect.getdoc(importlib.import_module(package)) or "",
            "",
            ".. autosummary::",
            "   :nosignatures:",
            "",
            *(f"   {name}" for name in names),
            "",
            ".. toctree::",
            "   :hidden:",
            "",
            *(f"   {name} <{package}/{name}>" for name in names),
            "",
        ]
    )


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
    """The words below a constant, in the module that the package's stub has it from."""
    stub = ast.parse(Path(str(importlib.import_module(package).__file__)).with_suffix(".pyi").read_text())
    (home,) = (
        node.module
        for node in stub.body
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}
    )
    analyzer = ModuleAnalyzer.for_module(f"{package}.{home}")
    analyzer.analyze()
    return structured(analyzer.attr_docs.get(("", name), []))
