"""Standard language: first words, banned words and names. Budgets only fall; the aim of each is zero."""

import re

import pytest
from style_rules import (
    GIVEN,
    HISTORY,
    OPENERS,
    begins_well,
    count_classes,
    find_banned,
    find_functions,
    find_headings,
    find_texts,
)
from test_house import DOCS, HOUSE, PACKAGED

TESTS = sorted((HOUSE / "tests").glob("test_*.py"))
PAGES = [
    *(HOUSE / name for name in ("README.md", "CONTRIBUTING.md")),
    *(path for path in DOCS if path.parent.name not in {"notes", "decisions"}),
]
LONGEST_TEST_NAME = 60


def check(found, most):
    """At most so many places break a rule: lower the number as they are rewritten."""
    assert len(found) <= most, f"{len(found)} places, at most {most}: {found[:20]}"


@pytest.mark.parametrize(("kind", "most"), [("docstring", 0), ("comment", 0), ("help", 0)])
def test_texts_begin_with_allowed_words(kind, most):
    texts = (text for path in PACKAGED for text in find_texts(path) if text.kind == kind)
    check([f"{one.place} {one.text[:40]}" for one in texts if not begins_well(one.text)], most)


@pytest.mark.parametrize(("kind", "most"), [("docstring", 0), ("comment", 0), ("help", 0), ("message", 0)])
def test_texts_contain_no_banned_words(kind, most):
    texts = (text for path in PACKAGED for text in find_texts(path) if text.kind == kind)
    check([f"{one.place} {word}" for one in texts for word in find_banned(one.text)], most)


def test_page_headings_begin_with_allowed_words():
    check([f"{path.name}: {it}" for path in PAGES for it in find_headings(path.read_text()) if not begins_well(it)], 0)


def test_pages_contain_no_banned_words():
    pages = {path: re.sub(r"^```.*?^```", "", path.read_text(), flags=re.M | re.S) for path in PAGES}
    check([f"{path.name}: {word}" for path, text in pages.items() for word in find_banned(text)], 0)


def test_pages_contain_no_history():
    check([f"{path.name}: {word}" for path in PAGES for word in HISTORY.findall(path.read_text())], 0)


def test_pages_have_at_most_3000_words():
    """At most 3,000 words a page and 220 kB in all."""
    pages = PAGES[2:]
    check([path.name for path in pages if len(path.read_text().split()) > 3000], 0)
    assert sum(path.stat().st_size for path in pages) <= 220_000


def test_class_names_are_unique():
    check([f"{name} ({count})" for name, count in count_classes(PACKAGED).items() if count > 1], 0)


def test_public_functions_begin_with_a_verb():
    names = {name for path in PACKAGED for name in find_functions(path)}
    check(sorted(name for name in names if name not in GIVEN and name.partition("_")[0] not in OPENERS), 0)


def test_test_names_have_at_most_60_characters():
    names = [name for path in TESTS for name in re.findall(r"^ *def (test_\w+)", path.read_text(), re.M)]
    assert len(names) > 2000
    check([name for name in names if len(name) > LONGEST_TEST_NAME], 0)


def test_style_rules_detect_violations(tmp_path):
    path = tmp_path / "a.py"
    path.write_text(
        '"""What it is."""\n# Of two lines\n# beside each other.\nX = 1  # which\n"""Quantity; `beside` is code."""\n'
        'class A:\n    """Class."""\n    def seen(self):\n        """See."""\n        return f"so many {X} words"\n'
        'parser.add_argument("--x", help="as many")\n'
    )
    found = find_texts(path)
    assert [(one.kind, begins_well(one.text)) for one in found] == [
        ("docstring", False),
        ("docstring", True),
        ("docstring", True),
        ("help", False),
        ("docstring", True),
        ("message", True),
        ("comment", False),
        ("comment", False),
    ]
    assert [(one.kind, find_banned(one.text)) for one in found if find_banned(one.text)] == [
        ("message", ["so many"]),
        ("comment", ["beside"]),
    ]
    assert list(find_functions(path)) == ["seen"] and count_classes([path, path]) == {"A": 2}
    assert find_headings("# A\n```sh\n# b\n```\n## C d") == ["A", "C d"]
