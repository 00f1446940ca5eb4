"""Names of the installed package, of code in docstrings and comments, and of cited works."""

import ast
import builtins
import re
import tomllib
from pathlib import Path

import pytest
from style_rules import find_texts
from test_house import FILES, HOUSE, nodes_of

import ar
import scenes
import sim
import surrogate
from sim.runtime.optional_packages import install_hint

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


def test_install_instructions_name_only_the_checkout():
    found = list(instructions())
    assert len(found) > 10
    for name, rest in found:
        words = re.sub(r"--constraint \S+|--quiet|--disable-pip-version-check|['\"(),;]", " ", rest).split()
        wrong = [word for word in words[:1] if not word.startswith(("-e", "--editable", "{")) and word not in OTHERS]
        assert not wrong, f"{name}: pip install{rest}"
        for extras in re.findall(r"\.\[([\w,]+)\]", rest):
            assert set(extras.split(",")) <= set(EXTRAS), f"{name}: {extras}"


@pytest.mark.parametrize("extra", ["camera", "data", "gym", "heads", "onnx", "peers", "report", "slicer"])
def test_install_hint_names_an_existing_extra(extra):
    assert extra in EXTRAS and install_hint(extra).endswith(f"pip install -e '.[{extra}]'.")


FOREIGN = {"onnx", "TensorProto", "trainbr", "fitrsvm", "eig3", "DataLoader", "PATH", "cov_00", "cov_55", "python"}
"""Names of other programs, and parts of names."""


def texts_and_names():
    """Docstrings and comments of the packages with their places, and every name and word of their code."""
    said, known = [], {*dir(builtins), *FOREIGN}
    for path in FILES:
        known |= {path.stem, *path.relative_to(HOUSE).parts[:-1]}
        docs = {id(node.value) for node in nodes_of(path) if isinstance(node, ast.Expr)}
        for node in nodes_of(path):
            names = [getattr(node, kind, None) for kind in ("id", "attr", "arg", "name", "asname", "module")]
            known |= {part for name in names if isinstance(name, str) for part in name.split(".")}
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
                known |= set(re.findall(r"\w+", node.value))
        said += [(one.place, one.text) for one in find_texts(path) if one.kind in ("docstring", "comment")]
    return said, known


def test_names_in_backticks_exist_in_the_code():
    said, known = texts_and_names()
    found = [(place, name) for place, text in said for name in re.findall(r"(?<!`)`([A-Za-z_][\w.]*)`(?!`)", text)]
    assert len(found) > 1000
    assert not [(place, name) for place, name in found if not set(filter(None, name.split("."))) <= known]


@pytest.mark.parametrize("package", [sim, surrogate, ar, scenes])
def test_former_public_names_are_aliases_of_current_names(package):
    assert package.FORMER and not set(package.FORMER) & set(package.__all__)
    assert all(getattr(package, former) is getattr(package, name) for former, name in package.FORMER.items())
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        package.nothing_of_this_name  # noqa: B018


def test_cited_titles_match_the_verified_list():
    """A new or changed citation is compared with its source, then listed."""
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
