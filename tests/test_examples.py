"""Every script in examples/ runs as a user runs it, in a folder of its own, and says what it is for."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
ELSEWHERE = EXAMPLES / "slicer_console.py"
"""What runs within another program, 3D Slicer, which is not here: only its names are held against that program's."""
SCRIPTS = sorted(set(EXAMPLES.glob("*.py")) - {ELSEWHERE})
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


# Where 3D Slicer, and its extension SlicerOpenIGTLink, declare what the example calls.
SLICER = {
    "Base/Python/slicer/util.py": {
        "getFirstNodeByClassByName", "loadTransform", "loadModel", "loadSegmentation", "loadMarkups", "loadVolume",
    },
    "Libs/MRML/Core/vtkMRMLScene.h": {"AddNewNodeByClass"},
    "Libs/MRML/Core/vtkMRMLNode.h": {"GetID"},
    "Libs/MRML/Core/vtkMRMLDisplayableNode.h": {"CreateDefaultDisplayNodes", "GetDisplayNode"},
    "Libs/MRML/Core/vtkMRMLDisplayNode.h": {"SetColor", "SetOpacity", "SetVisibility2D"},
    "Libs/MRML/Core/vtkMRMLTransformableNode.h": {"SetAndObserveTransformNodeID"},
    "OpenIGTLinkIF/MRML/vtkMRMLIGTLConnectorNode.h": {"SetTypeClient", "Start", "Stop"},
}  # fmt: skip
PYTHONS = {"util", "mrmlScene", "items", "suffix", "is_file"}
"""Modules of Slicer, and what is Python's own."""


def test_the_example_for_slicer_calls_what_slicer_has():
    tree = ast.parse(ELSEWHERE.read_text())
    compile(tree, ELSEWHERE.name, "exec")
    used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert used == set().union(PYTHONS, *SLICER.values())


def test_the_example_for_slicer_ends_in_a_sentence_elsewhere(tmp_path):
    done = subprocess.run([sys.executable, ELSEWHERE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "Run it in the Python console of 3D Slicer" in done.stderr
    assert "Traceback" not in done.stderr
