"""Budgets of lines, and options that are declared once."""

import re

from test_house import HOUSE, PACKAGED

# Lines of the packages and of their tests. Nobody reads more than this: a feature that exceeds it deletes something.
# Lower a number when lines have gone. Raise it only with the reason in the commit.
MOST = {"packages": 80_550, "tests": 50_000}


def lines(paths):
    return sum(path.read_text().count("\n") for path in paths)


def test_lines_are_within_their_budget():
    stubs = [
        path for room in {path.relative_to(HOUSE).parts[0] for path in PACKAGED} for path in HOUSE.glob(f"{room}/*.pyi")
    ]
    found = {"packages": lines([*PACKAGED, *stubs]), "tests": lines((HOUSE / "tests").glob("*.py"))}
    assert not {name: count for name, count in found.items() if count > MOST[name]}


def test_shared_options_are_declared_in_one_file():
    shared = {
        "json": "action=",
        "device": 'default="auto", help',
        "seed": "type=",
        "anatomy": 'type=Path, help=".vtu made',
    }
    usual = "|".join(re.escape(f'"--{name}", {rest}') for name, rest in shared.items())
    files = [*PACKAGED, *HOUSE.glob("benchmarks/commands/*.py")]
    found = [path.name for path in files if re.search(usual, path.read_text())]
    assert found == ["drawn_options.py", "shared_options.py"]  # the latter: of a group of its own
