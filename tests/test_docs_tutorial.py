"""The page docs/tutorial.md: its Python and commands run, with the shipped template instead of a trained patient."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from scenes.cli import main, make_parsers
from scenes.script.shipped_files import get_template_path

PAGE = (Path(__file__).parents[1] / "docs/tutorial.md").read_text()
(OBSERVE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
LINES = [
    shlex.split(line) for line in re.findall(r"^sulcus .*$", PAGE.replace("$TEMPLATE", str(get_template_path())), re.M)
]
DEMO, INSPECT, PATIENT, RENDER, LOCATE, LOCATOR = (line[1:] for line in LINES)


@pytest.mark.parametrize("command", [DEMO, INSPECT, PATIENT, RENDER, LOCATE, LOCATOR], ids=lambda line: line[0])
def test_tutorial_command_is_parsed(command):
    assert make_parsers(command[0])[0].parse_args(command).command == command[0]


def test_tutorial_sample_gives_the_output_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(INSPECT) == 0 and Path("patient.inspect.png").exists()
    shown = PAGE.partition("--inspect\n```\n\n```text\n")[2].partition("```")[0]
    assert shown.count("\n") >= 6 and shown in capsys.readouterr().out
    sources = ["--labels", "sample_labels.nii.gz", "--brain", "1", "--tumour", "2", "--t1", "sample_t1.nii.gz"]
    assert PATIENT[:4] == ["patient", "--sample", "--nodes", "2000"]
    assert main(["anatomy", *sources, *PATIENT[2:4], "--out", "mesh.vtu"]) == 0
    mesh = re.search(r"^\d+ nodes, \d+ tetrahedra.*?(?=^\.\.\.$)", PAGE, re.MULTILINE | re.DOTALL)
    assert mesh and mesh[0].count("\n") == 3 and mesh[0] in capsys.readouterr().out


def test_tutorial_tumour_is_located(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for suffix in (".vtu", ".model.npz"):
        shutil.copy(get_template_path().with_suffix(suffix), f"patient{suffix}")
    assert main(RENDER) == 0 and Path("frames/frame_0060.png").exists()
    names = {}
    exec(OBSERVE, names)
    capsys.readouterr()
    assert names["result"].outcome[0].good and main([*LOCATE, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert np.linalg.norm(found["centroid_mm"] - 1e3 * names["tumour"].mean(axis=0)) < found["p95_mm"]
