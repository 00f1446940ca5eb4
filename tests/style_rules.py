"""Rules of form for docstrings, comments, help strings, headings and names."""

import ast
import inspect
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from test_house import nodes_of, tree_of

FIRST_WORDS = re.compile(r"\W*(?:what|how|where|whether|which|who|whose|whom|of|as|why|by|that)\b", re.IGNORECASE)
"""Words that begin no docstring, comment, help string or heading."""
BANNED = re.compile(
    r"\b(?:so (?:many|much|far|long|exactly)|beside|anew|nobody|somebody|whoever|of (?:no )?account|by itself|heard"
    r"|felt|(?:is|are) said|in turn|make good|want of|goes on|promised|refus(?:e[sd]?|al)|pictures?"
    r"|(?<!sulcus )(?<![\w/])film(?:s|ed)?(?![\w/.])"
    r"|answer(?:s|ed)?|off by|far off|mm off|above all|likewise|stated|learnt|(?:un)?taught|teach(?:es|ing)?|told"
    r"|vicinit(?:y|ies)|lanes?|rungs?)\b",
    re.IGNORECASE,
)
"""Words that have a standard term instead."""
HISTORY = re.compile(
    r"\b(?:earlier (?:than|versions?|runs?)|formerly|used to|until 20\d\d|was aimed|was tried|no longer)\b"
)
"""Words of history, for which user pages have no room."""
QUOTED = re.compile(
    r"``[^`]+``|`[^`]+`|\$[^$]+\$|\"[^\"]*\"|<code>[^<]*</code>|--[\w-]+|\b\w+:[\w-]+|^  [^\n]*$", re.MULTILINE
)
"""Code, commands, formulas and titles of cited works."""
FOREIGN = re.compile(r"[{};]\n(?:.*\n)*?.*[{};]$", re.MULTILINE)
"""Ends of lines in strings of JavaScript, CSS or C."""
NAMES = re.compile(r"^[\w*, ]+\n {4}(?=(\S.*)$)", re.MULTILINE)
"""Names of parameters above their description, whose first line is the group."""
VERBS = frozenset((Path(__file__).parent / "data/verbs.txt").read_text().split())
"""Verbs that public functions begin with, next to `is`, `has`, `can`, `to`, `from` and `as`."""
OPENERS = VERBS | {"is", "has", "can", "to", "from", "as"}
GIVEN = set(
    re.findall(
        r"\w+",
        """
    main backward readinto data_received isOpened astype argmin min max
    energy gradient residual curvature slope rest_curvature second_order longest_step
    coefficients_at term pose state restored
""",
    )
)
"""Functions without a verb: of other libraries; quantities in mathematics; methods that extensions implement."""


class Text(NamedTuple):
    """Piece of prose: its kind, its place and its words."""

    kind: str
    place: str
    text: str


def is_string(node: ast.AST | None) -> bool:
    """Return True for a literal or formatted string."""
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def to_text(node: ast.AST) -> str:
    """Text of a string node; each value that is filled in counts as one word."""
    if isinstance(node, ast.JoinedStr):
        return "".join(to_text(part) if isinstance(part, ast.Constant) else "x" for part in node.values)
    return str(node.value) if isinstance(node, ast.Constant) else ""


@cache
def find_texts(path: Path) -> tuple[Text, ...]:
    """Docstrings (also those under constants), comments, help strings and messages of a Python file."""
    found, used = [], set()
    nodes = nodes_of(path)
    for node in nodes:
        if isinstance(node, ast.Expr) and is_string(node.value):
            used.add(id(node.value))
            found.append(Text("docstring", f"{path.name}:{node.lineno}", inspect.cleandoc(to_text(node.value))))
        for word in node.keywords if isinstance(node, ast.Call) else []:
            if word.arg in ("help", "description", "epilog") and is_string(word.value):
                used |= {id(part) for part in ast.walk(word.value)}
                found.append(Text("help", f"{path.name}:{word.value.lineno}", to_text(word.value)))
    for node in nodes:  # a formatted string comes before its parts
        if is_string(node) and id(node) not in used and " " in to_text(node).strip():
            used |= {id(part) for part in ast.walk(node)}
            found.append(Text("message", f"{path.name}:{node.lineno}", to_text(node)))  # type: ignore[attr-defined]
    found += [Text("comment", f"{path.name}:{row}", text) for row, text in find_comments(path.read_text())]
    return tuple(found)


def find_comments(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of each comment; consecutive lines at one column are one comment."""
    first, last, column, text = 0, -1, -1, ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            words = token.string.lstrip("#").strip()
            if token.start == (last + 1, column):
                last, text = last + 1, f"{text} {words}"
                continue
            if text:
                yield first, text
            (first, column), last, text = token.start, token.start[0], words
    if text:
        yield first, text


def find_headings(page: str) -> list[str]:
    """Headings of a Markdown page."""
    return re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)


def begins_well(text: str) -> bool:
    """Return True unless text or the description of a parameter begins with a word of `FIRST_WORDS`."""
    return all(part.lstrip().startswith("`") or not FIRST_WORDS.match(part) for part in (text, *NAMES.findall(text)))


def find_banned(text: str) -> list[str]:
    """Banned words of a text, outside code, formulas, titles and names of parameters."""
    return [] if FOREIGN.search(text) else BANNED.findall(QUOTED.sub("x", NAMES.sub("", text)))


def find_functions(path: Path) -> Iterator[str]:
    """Names of public functions and methods: no properties, kernels, overloads or tests of a base class's name."""
    for owner in [tree_of(path), *(node for node in nodes_of(path) if isinstance(node, ast.ClassDef))]:
        for node in owner.body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                marks = {ast.unparse(mark).partition("(")[0].rpartition(".")[2] for mark in node.decorator_list}
                if not marks & {"property", "cached_property", "setter", "func", "func_native", "kernel", "overload"}:
                    yield node.name


def count_classes(paths: Iterable[Path]) -> Counter[str]:
    """Number of definitions of each class name."""
    return Counter(node.name for path in paths for node in nodes_of(path) if isinstance(node, ast.ClassDef))
