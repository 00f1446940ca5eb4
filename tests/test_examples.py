"""Every script in examples/ runs as a user runs it, in a folder of its own, and says what it is for."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
PARTS = {"nearest.py", "sucker.py", "veins.py", "yeoh.py"}
"""What other files of a user import; tests of their own hold their numbers. All others assert one."""


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_an_example_runs(script, tmp_path):
    alone = {"CUDA_VISIBLE_DEVICES": "", "DISPLAY": ""}
    done = subprocess.run(
        [sys.executable, "-W", "error", script],
        cwd=tmp_path,
        env=os.environ | alone,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_the_list_of_parts_names_examples():
    assert PARTS.issubset(script.name for script in SCRIPTS)


@pytest.mark.parametrize("script", [path for path in SCRIPTS if path.name not in PARTS], ids=lambda path: path.stem)
def test_an_example_is_short_and_asserts_a_number(script):
    tree = ast.parse(script.read_text())
    title, blank, *rest = (ast.get_docstring(tree) or "").splitlines()
    assert title and not blank and 1 <= len(rest) <= 4
    assert len(script.read_text().splitlines()) <= 60
    asserted = [node for node in ast.walk(tree) if isinstance(node, ast.Assert)]
    assert any(isinstance(node, ast.Compare) for line in asserted for node in ast.walk(line))
