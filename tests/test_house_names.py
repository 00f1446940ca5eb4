"""Names that point elsewhere: of the installed package, of code in docstrings and comments, of cited works."""

import ast
import builtins
import io
import re
import tokenize
import tomllib
from pathlib import Path

import pytest

from sim.runtime import versions
from sim.runtime.optional_packages import install_hint
from sim.runtime.versions import DISTRIBUTION, get_version

HOUSE = Path(__file__).parents[1]
PROJECT = tomllib.loads((HOUSE / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
SUFFIXES = {".py", ".md", ".toml", ".yml", ".cfg", ".cff", ".txt", ""}
OTHERS = {"torch==VERSION", "pre-commit", "dist/sulcus_ar-*.whl", "."}
"""What else instructions install."""


def instructions():
    """Every `pip install` in the repository: file, and what follows in its line."""
    for path in sorted(HOUSE.rglob("*")):
        hidden = any(part.startswith(".") and part not in (".ci", ".github") for part in path.relative_to(HOUSE).parts)
        if (
            hidden
            or path.suffix not in SUFFIXES
            or not path.is_file()
            or path == Path(__file__)
            or "build" in path.parts
        ):
            continue
        for rest in re.findall(r"\bpip install([^\n`]*)", path.read_text(errors="replace")):
            yield path.relative_to(HOUSE).as_posix(), rest


def test_distribution_has_one_name():
    assert PROJECT["name"] == DISTRIBUTION and DISTRIBUTION != "sulcus"
    own = [one for extra in EXTRAS.values() for one in extra if re.match(r"sulcus\b", one)]
    assert own == [f"{DISTRIBUTION}[camera,data,docs,gym,onnx,report,slicer]"]


def test_instructions_install_the_checkout_and_no_other_name():
    found = list(instructions())
    assert len(found) > 10
    for name, rest in found:
        words = re.sub(r"--constraint \S+|--quiet|--disable-pip-version-check|['\"(),;]", " ", rest).split()
        wrong = [word for word in words[:1] if not word.startswith(("-e", "--editable", "{")) and word not in OTHERS]
        assert not wrong, f"{name}: pip install{rest}"
        for extras in re.findall(r"\.\[([\w,]+)\]", rest):
            assert set(extras.split(",")) <= set(EXTRAS), f"{name}: {extras}"


@pytest.mark.parametrize("extra", ["camera", "data", "gym", "heads", "onnx", "peers", "report", "slicer"])
def test_install_hint_names_an_extra_that_exists(extra):
    assert extra in EXTRAS and install_hint(extra).endswith(f"pip install -e '.[{extra}]'.")


def test_version_of_uninstalled_checkout_is_the_projects(monkeypatch):
    def gone(name):
        raise versions.PackageNotFoundError(name)

    assert get_version("sulcus") == PROJECT["version"]
    monkeypatch.setattr(versions, "version", gone)
    assert get_version.__wrapped__("sulcus") == PROJECT["version"]
    with pytest.raises(versions.PackageNotFoundError):
        get_version.__wrapped__("numpy")


FOREIGN = {
    "onnx",
    "TensorProto",
    "trainbr",
    "fitrsvm",
    "eig3",
    "DataLoader",
    "PATH",
    "cov_00",
    "cov_55",
    "python",
    "_in_row",
}
"""Names of other programs, and parts of names."""


def texts_and_names():
    """Docstrings and comments of the packages with their places, and every name and word of their code."""
    said, known = [], {*dir(builtins), *FOREIGN}
    for path in [
        path
        for room in ("sim", "surrogate", "ar", "scenes", "benchmarks")
        for path in sorted((HOUSE / room).rglob("*.py"))
    ]:
        text, docs = path.read_text(), set()
        tree = ast.parse(text)
        known |= {path.stem, *path.relative_to(HOUSE).parts[:-1]}
        for node in ast.walk(tree):
            names = [getattr(node, kind, None) for kind in ("id", "attr", "arg", "name", "asname", "module")]
            known |= {part for name in names if isinstance(name, str) for part in name.split(".")}
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                docs.add(node.value)
                said.append((f"{path.relative_to(HOUSE)}:{node.lineno}", node.value.value))
        strings = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and node not in docs)
        known |= {word for node in strings if isinstance(node.value, str) for word in re.findall(r"\w+", node.value)}
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        said += [
            (f"{path.relative_to(HOUSE)}:{one.start[0]}", one.string) for one in tokens if one.type == tokenize.COMMENT
        ]
    return said, known


def test_names_in_backticks_exist():
    said, known = texts_and_names()
    found = [(place, name) for place, text in said for name in re.findall(r"(?<!`)`([A-Za-z_][\w.]*)`(?!`)", text)]
    assert len(found) > 1000
    assert not [(place, name) for place, name in found if not set(filter(None, name.split("."))) <= known]


def test_cited_titles_match_their_checked_list():
    """A new citation, or one that a rename has changed, is compared with its source, then listed."""
    listed = set((HOUSE / "tests/data/citations.txt").read_text().splitlines())
    paths = [
        path
        for room in ("sim", "surrogate", "ar", "scenes", "benchmarks", "docs", "examples")
        for path in (HOUSE / room).rglob("*")
    ]
    found = set()
    for path in [*paths, HOUSE / "README.md"]:
        if path.suffix in {".py", ".md"} and "generated" not in path.parts:
            text = re.sub(r"\"\n\s+f?\"", "", path.read_text())
            text = re.sub(r"\s+#?\s*", " ", text)
            cited = re.findall(r"[A-Za-zéöü.],? \(?((?:1[89]|20)\d\d)\)?,? \"([^\"]{6,200})\"", text)
            found |= {f"{year} {title}" for year, title in cited}
    assert len(found) > 60
    assert found == listed, sorted(found ^ listed)
