"""The page docs/extend.md: its code runs in a folder outside the packages, and it names only what there is."""

import argparse
import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scenes.script.scene import find_scene
from scenes.script.shipped_files import template_path

HOUSE = Path(__file__).parents[1]
PAGE = (HOUSE / "docs/extend.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A researcher's, with copies of the examples."""
    folder = tmp_path_factory.mktemp("extend")
    for path in (HOUSE / "examples").glob("*.py"):
        shutil.copy(path, folder)
    return folder


def test_the_first_block_is_a_scene(folder):
    (folder / "my_scene.py").write_text(BLOCKS[0])
    scene = find_scene(str(folder / "my_scene.py"))
    assert scene.name == "stiff" and "my_scene.py" in PAGE


def test_the_blocks_run_one_after_the_other(folder):
    """In an interpreter of its own that runs elsewhere; what they print says that veins hold tissue back."""
    (folder / "page.py").write_text("\n".join(BLOCKS[1:]))
    paths = {**os.environ, "PYTHONPATH": str(HOUSE)}
    done = subprocess.run([sys.executable, "page.py"], cwd=folder, capture_output=True, text=True, env=paths)
    assert done.returncode == 0, done.stderr
    assert "Hooke's law at small strain: off by" in done.stdout
    free, held = map(float, done.stdout.splitlines()[-1].split())
    assert 5e-4 < held < 0.9 * free


def test_the_command_says_how_large_the_tumour_is(capsys):
    (block,) = (block for block in BLOCKS if "def add_arguments" in block)
    names = {}
    exec(block, names)
    parser = argparse.ArgumentParser()
    names["add_arguments"](parser)
    assert names["run"](parser.parse_args([str(template_path())])) == 0
    assert float(capsys.readouterr().out.removesuffix(" ml\n")) == pytest.approx(4 / 3 * np.pi * 1.2**3, rel=0.05)


def test_every_part_of_ones_own_is_on_the_page_and_every_name_there_exists():
    for part in ("nearest", "sucker", "veins", "yeoh"):
        assert f"examples/{part}.py" in PAGE
    names = set(re.findall(r"`((?:sim|scenes|surrogate)(?:\.[a-z_]+)*)\.([A-Z]\w+)`", PAGE))
    assert len(names) >= 8
    for module, name in names:
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"
