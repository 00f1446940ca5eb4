"""The name under which the package is installed, and names that comments and docstrings point to."""

import re
import tomllib
from pathlib import Path

import pytest

from sim.runtime import versions
from sim.runtime.versions import DISTRIBUTION, install_hint, version_of

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
    assert own == [f"{DISTRIBUTION}[docs,exports,gym,link,onnx]"]


def test_instructions_install_the_checkout_and_no_other_name():
    found = list(instructions())
    assert len(found) > 10
    for name, rest in found:
        words = re.sub(r"--constraint \S+|--quiet|--disable-pip-version-check|['\"(),;]", " ", rest).split()
        wrong = [word for word in words[:1] if not word.startswith(("-e", "--editable", "{")) and word not in OTHERS]
        assert not wrong, f"{name}: pip install{rest}"
        for extras in re.findall(r"\.\[([\w,]+)\]", rest):
            assert set(extras.split(",")) <= set(EXTRAS), f"{name}: {extras}"


@pytest.mark.parametrize("extra", ["anatomies", "exports", "gym", "link", "onnx", "peers"])
def test_install_hint_names_an_extra_that_exists(extra):
    assert extra in EXTRAS and install_hint(extra).endswith(f"pip install -e '.[{extra}]'.")


def test_version_of_checkout_that_is_not_installed_is_the_projects(monkeypatch):
    def gone(name):
        raise versions.PackageNotFoundError(name)

    assert version_of("sulcus") == PROJECT["version"]
    monkeypatch.setattr(versions, "version", gone)
    assert version_of.__wrapped__("sulcus") == PROJECT["version"]
    with pytest.raises(versions.PackageNotFoundError):
        version_of.__wrapped__("numpy")
