"""Page docs/extend.md: its code runs outside the packages, and its names exist."""

import argparse
import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import meshio
import numpy as np
import pytest

from scenes.script.scene import find_scene
from scenes.script.shipped_files import get_template_path
from sim import Bonded, Elasticity, Fem, Held, ToolForce, open_cortex, push, read_anatomy
from surrogate.model.own_learners import ENTRY_POINT_GROUP

HOUSE = Path(__file__).parents[1]
PAGE = (HOUSE / "docs/extend.md").read_text()
PATIENT = (HOUSE / "docs/own_mesh.md").read_text()


def blocks_of(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


BLOCKS = blocks_of(PAGE)
SECTIONS = ["\n".join(blocks_of(section)) for section in PAGE.split("\n## ")[1:] if blocks_of(section)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A researcher's, with copies of the examples."""
    folder = tmp_path_factory.mktemp("extend")
    for path in (HOUSE / "examples").glob("*.py"):
        shutil.copy(path, folder)
    return folder


def test_first_code_block_of_extend_page_defines_a_scene(folder):
    (folder / "my_scene.py").write_text(BLOCKS[0])
    scene = find_scene(str(folder / "my_scene.py"))
    assert scene.name == "stiff" and "my_scene.py" in PAGE


def test_code_of_each_section_runs_separately(folder):
    """In an interpreter in another folder; no section uses names of another. Veins stiffen the tissue."""
    assert len(SECTIONS) == 7
    (folder / "page.py").write_text(
        f"for section in {SECTIONS[1:]!r}:\n    exec(section, {{'__name__': '__main__'}})\n"
    )
    paths = {**os.environ, "PYTHONPATH": str(HOUSE)}
    done = subprocess.run([sys.executable, "page.py"], cwd=folder, capture_output=True, text=True, env=paths)
    assert done.returncode == 0, done.stderr
    *_, law, veins, first, second = done.stdout.splitlines()
    assert "Hooke's law at small strain: relative error" in done.stdout and "single precision" in law
    free, held = map(float, veins.split())
    assert 5e-4 < held < 0.9 * free
    forces = [[float(figure) for figure in row.strip("[] ").split()] for row in (first, second)]
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 0.1, rtol=1e-3)


def test_example_plugin_has_a_complete_project_file():
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    project = tomllib.loads(text)["project"]
    assert project["name"] and project["version"]
    assert project["entry-points"][ENTRY_POINT_GROUP] == {"nearest": "my_package.nearest"}


def test_own_mesh_is_converted_to_an_anatomy(tmp_path, monkeypatch, box):
    """Code of docs/own_mesh.md, on a file in millimetres."""
    (code,) = blocks_of(PATIENT)
    mesh = box.mesh
    cells, region = [("tetra", mesh.tets)], [mesh.region]
    meshio.write(tmp_path / "head.vtu", meshio.Mesh(1e3 * mesh.nodes, cells, cell_data={"region": region}))
    middle = mesh.nodes[box.craniotomy].mean(axis=0)
    monkeypatch.chdir(tmp_path)
    exec(re.sub(r"np.array\(\[.*?\]\)", f"np.array({(1e3 * middle).tolist()})", code, count=1), {})
    own = read_anatomy("own.vtu")
    assert set(own.tumour_nodes) == set(box.tumour_nodes) and len(own.open_surface)
    pushed = push(open_cortex(own).place().point, [0.0, 0.0, -0.05], 6e-3)
    answer = Fem(own, (Elasticity(), Held(), Bonded(), ToolForce()), device="cpu", element="p1").deform(pushed)
    assert answer.outcome[0].good and np.abs(answer.displacement[0, own.tumour_nodes]).max() > 1e-5


def test_example_command_prints_the_tumour_volume(capsys):
    (block,) = (block for block in BLOCKS if "def add_arguments" in block)
    names = {}
    exec(block, names)
    parser = argparse.ArgumentParser()
    names["add_arguments"](parser)
    assert names["run"](parser.parse_args([str(get_template_path())])) == 0
    assert float(capsys.readouterr().out.removesuffix(" ml\n")) == pytest.approx(4 / 3 * np.pi * 1.2**3, rel=0.05)


def test_parts_named_on_the_extend_page_exist():
    for part in ("nearest", "sucker", "veins", "yeoh"):
        assert f"examples/{part}.py" in PAGE
    names = set(re.findall(r"`((?:sim|scenes|surrogate)(?:\.[a-z_]+)*)\.([A-Z]\w+)`", PAGE))
    assert len(names) >= 8
    for module, name in names:
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"
