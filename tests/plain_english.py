"""Sentences of docstrings, help texts and pages, and how long they are."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

LONGEST = 29
"""Words of a sentence, at most."""
CODE = re.compile(r"``[^`]+``|`[^`]+`|\$[^$]+\$|(?:[\w)]+\s*[=<>~]+\s*)+\S+")
"""Names in backticks and formulas."""
LINK = re.compile(r"!?\[([^]]*)\]\([^)]*\)")
END = re.compile(r"(?<=[.!?])[)\"'*_]*\s+(?=\S)")
SHORT = re.compile(r"\b(?:e\.g|i\.e|et al|vs|cf|eq|eqs|fig|no|approx|resp)\.", re.IGNORECASE)
"""What ends in a full stop, but no sentence."""


def words(sentence: str) -> int:
    """How many words; a formula, or a name in backticks, counts as one."""
    plain = CODE.sub("code", LINK.sub(r"\1", sentence))
    return sum(any(letter.isalnum() for letter in word) for word in plain.split())


def sentences(text: str) -> list[str]:
    """The sentences of plain text whose paragraphs are parted by empty lines."""
    found = []
    for paragraph in re.split(r"\n\s*\n", text):
        line = SHORT.sub(lambda match: match[0][:-1], " ".join(paragraph.split()))
        found += [each for each in END.split(line) if each]
    return found


def too_long(text: str) -> list[str]:
    """The sentences of more than `LONGEST` words."""
    return [each for each in sentences(text) if words(each) > LONGEST]


def docstrings(path: Path) -> Iterator[tuple[str, str]]:
    """The place and the text of each docstring of a file; the words below constants are some."""
    for node in ast.walk(ast.parse(path.read_text())):
        inside = getattr(node, "body", None)
        for child in inside if isinstance(inside, list) else []:
            found = child.value if isinstance(child, ast.Expr) else None
            if isinstance(found, ast.Constant) and isinstance(found.value, str):
                yield f"{path.name}:{child.lineno}", inspect.cleandoc(found.value)


def messages(path: Path) -> Iterator[tuple[str, str]]:
    """The place and the text of each string of a file that is no docstring; what is filled in counts as a word."""
    tree = ast.parse(path.read_text())
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    inner |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        parts = node.values if isinstance(node, ast.JoinedStr) else [node]
        if id(node) in inner or not any(isinstance(part, ast.Constant) for part in parts):
            continue
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in parts)
        if "{" not in text:  # a style sheet or a script
            yield f"{path.name}:{node.lineno}", re.sub("<[^>]*>", "\n\n", text)


def prose(docstring: str) -> str:
    """The running text of a numpydoc docstring: no headings, examples, formulas, or names that are described."""
    text = re.sub(r"^Examples\n-{3,}\n(?s:.*)", "", docstring, flags=re.MULTILINE)
    lines, described = [], False
    given = [*text.splitlines(), ""]
    for line, after in pairwise(given):
        inset = len(line) - len(line.lstrip())
        heading = set(after) == {"-"} and len(after) > 2
        described = described or heading
        name = described and not inset and after.startswith("    ")
        formula = inset >= 4 and not described
        if heading or name or formula or (line and set(line) == {"-"}):
            lines.append("")
        else:
            item = re.match(r"\s*(?:[-*]|\d\.) ", line)
            lines += ["", line] if item else [line]
    return "\n".join(lines)


def paragraphs(page: str) -> str:
    """The running text of a Markdown page: no code, tables, headings; each item of a list is a paragraph."""
    text = re.sub(r"^(```|\$\$).*?^\1.*?$", "", page, flags=re.MULTILINE | re.DOTALL)
    lines = []
    for line in text.splitlines():
        if line.startswith(("#", "|", "!", "<", ":")):
            lines.append("")
        else:
            lines += ["", line] if re.match(r"\s*(?:[-*]|\d+\.) ", line) else [line]
    return "\n".join(lines)
