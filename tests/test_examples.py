"""Every script in examples/ runs like a user's, in an empty folder, and states its purpose."""

import ast
import contextlib
import io
import json
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
def test_example_runs_without_warnings(script, tmp_path):
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


def test_notebook_output_agrees_with_its_stored_output():
    notebook = json.loads((EXAMPLES / "first_steps.ipynb").read_text())
    assert notebook["nbformat"] == 4 and notebook["nbformat_minor"] == 5 and len(notebook["cells"]) <= 12
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    names = {}
    for cell in notebook["cells"]:
        assert cell["metadata"] == {} and cell["source"]
        if cell["cell_type"] == "code":
            with contextlib.redirect_stdout(io.StringIO()) as shown:
                exec("".join(cell["source"]), names)
            assert [*map(set, cell["outputs"])] == [{"name", "output_type", "text"}] * bool(shown.getvalue())
            assert "".join(text for output in cell["outputs"] for text in output["text"]) == shown.getvalue()
    assert names["errors"].max() < 1e3 * names["predicted"].bound[0, 0]
    assert names["png"].startswith(b"\x89PNG") and names["frame"].shown.std() > 20.0


def test_list_of_parts_names_existing_examples():
    assert PARTS.issubset(script.name for script in SCRIPTS)


@pytest.mark.parametrize("script", [path for path in SCRIPTS if path.name not in PARTS], ids=lambda path: path.stem)
def test_example_is_short_and_asserts_a_number(script):
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


def test_slicer_example_calls_only_known_slicer_functions():
    tree = ast.parse(ELSEWHERE.read_text())
    compile(tree, ELSEWHERE.name, "exec")
    used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert used == set().union(PYTHONS, *SLICER.values())


def test_slicer_example_outside_slicer_ends_with_message(tmp_path):
    done = subprocess.run([sys.executable, ELSEWHERE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "Run it in the Python console of 3D Slicer" in done.stderr
    assert "Traceback" not in done.stderr
