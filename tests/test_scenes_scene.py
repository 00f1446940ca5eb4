"""Scene files of users: played by each command, and rejected where invalid."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from theatres import put, theatre_of

from scenes.cli import main
from scenes.play.deformers import PatientSetup
from scenes.play.stage import TOOL
from scenes.script.scene import find_scene
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.errors import InputError
from sim.runtime.user_script import run_script
from sim.tools import compute_distances

OWN = '''"""The tool nods twice."""

from own_strokes import nod
from scenes.script.scene import Scene, Viewpoint

SCENE = Scene("nod", __doc__, nod(0.2), duration=0.07, viewpoint=Viewpoint(width=400, height=300))
'''
STROKES = """from scenes.script.tool_paths import press

def nod(force):
    return press(force, rise=0.04, hold=0.0)
"""


@pytest.fixture(scope="module")
def folder(box, tmp_path_factory):
    """A researcher's: a brain with its models, a scene, and a module that the scene imports."""
    folder = tmp_path_factory.mktemp("own")
    put(theatre_of(box), folder / "box.vtu")
    (folder / "my_scene.py").write_text(OWN)
    (folder / "own_strokes.py").write_text(STROKES)
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["render", "--out", "frames", "--every", "2", "--json"],
        ["collect", "--out", "nod.h5", "--json"],
        ["check", "--every", "1", "--json"],
        ["demo", "--seconds", "0.01", "--port", "8765"],
    ],
    ids=lambda words: words[0],
)
def test_commands_play_a_scene_file(folder, monkeypatch, capsys, words):
    monkeypatch.chdir(folder)
    done = main([words[0], "my_scene.py", *words[1:], "--anatomy", "box.vtu", "--deformer", "linear"])
    out, err = capsys.readouterr()
    assert done == 0, err
    if "--json" in words:
        reported = json.loads(out)
        assert (reported["scenes"][0] if words[0] == "check" else reported)["scene"] == "nod"


def test_effects_command_measures_a_scene_file(folder, small_box, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    write_anatomy(folder / "small.vtu", small_box)
    assert main(["effects", "my_scene.py", "--every", "1", "--anatomy", "small.vtu", "--device", "cpu", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["scene"] == "nod" and "ToolForce" in {row["effect"] for row in reported["effects"]}


SUCKER = Path(__file__).parents[1] / "examples/sucker.py"
HELD_BY = """from dataclasses import replace

from scenes.script.scene import Viewpoint
from own_sucker import SCENE as LAID, Sucker

TOOL = Sucker(stl="sucker.stl")
SCENE = replace(LAID, tool=TOOL, duration=1.0, viewpoint=Viewpoint(width=160, height=120))
"""


def test_custom_tool_uses_its_own_mesh_and_shape(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    (folder / "own_sucker.py").write_text(SUCKER.read_text())
    (folder / "held.py").write_text(HELD_BY)
    look = trimesh.creation.box([30.0, 4.0, 50.0])
    look.apply_translation([0.0, 0.0, 25.0])
    look.export(folder / "sucker.stl")
    scene = find_scene("held.py")
    assert np.ptp(scene.tool.mesh.vertices, axis=0) == pytest.approx([0.03, 0.004, 0.05], abs=1e-6)
    box = PatientSetup(read_anatomy("box.vtu"), None, {}, "cpu")
    frames = list(box.build_player("fem", scene).play_frames(every=15))
    assert all(frame.deformation.outcome[0].good for frame in frames)
    assert np.abs(frames[-1].deformation.displacement).max() > 1e-3
    assert (frames[-1].picture.segmentation == TOOL).sum() > 100
    reads = frames[-1].deformation.reaction[0]
    assert reads.shape == (1, 6) and np.linalg.norm(reads[0, :3]) > 1e-3
    there = frames[-1].pose
    tip = compute_distances(scene.tool.shape, there, box.anatomy.mesh.nodes + frames[-1].deformation.displacement[0])
    assert tip.min() > -1e-4  # no vertex is inside of it


WRONG = """from dataclasses import replace
from typing import Any

import warp as wp
from scenes.builtin.press import SCENE as PRESS
from sim.effects import Elasticity
from yeoh import Yeoh, stress as own


@wp.func
def half(H: Any, c: Any):
    return own(H, c) / type(c[0])(2.0)


class Mine(Yeoh):
    law = "mine"
    functions = replace(Yeoh.functions, stress=half) if HALF else Yeoh.functions


SCENE = replace(PRESS, effects=(Elasticity(Mine(500.0, 1500.0, 1e4)), *PRESS.effects[1:]))
"""


@pytest.mark.parametrize("half", [False, True])
def test_scene_is_rejected_only_for_inconsistent_law(tmp_path, half):
    (tmp_path / "yeoh.py").write_text(SUCKER.with_name("yeoh.py").read_text())
    path = tmp_path / "mine.py"
    path.write_text(WRONG.replace("HALF", str(half)))
    if not half:
        assert find_scene(str(path)).effects[0].default.law == "mine"
        return
    with pytest.raises(InputError, match=r"mine\.py: the law mine does not hold: .*stress is the energy's derivative"):
        find_scene(str(path))


DERIVED = """from dataclasses import dataclass, replace
from typing import Any

import warp as wp
from scenes.builtin.press import SCENE as PRESS
from sim.effects import Elasticity
from sim.material import Material
from sim.terms.laws.neo_hookean import LAW, stress as own


@wp.func
def half(H: Any, c: Any):
    return own(H, c) / type(c[0])(2.0)


@dataclass(frozen=True)
class Mine(Material):
    @property
    def functions(self):
        return replace(LAW, stress=half)


MINE = Elasticity(None, {region: Mine("neo-hookean", 3000.0, 0.45) for region in (1, 2)})
SCENE = replace(PRESS, effects=(MINE, *PRESS.effects[1:]))
"""


def test_scene_with_wrong_derived_law_is_rejected(tmp_path):
    path = tmp_path / "derived.py"
    path.write_text(DERIVED)
    words = r"derived\.py: the law neo-hookean does not hold: .*stress is the energy's derivative"
    with pytest.raises(InputError, match=words):
        find_scene(str(path))


def test_script_runs_again_only_after_a_change(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("class Mine: pass\n")
    first = run_script(path)
    assert run_script(path) is first and sys.modules[first.__name__] is first
    path.write_text("class Mine: number = 2\n")
    assert run_script(path).Mine.number == 2 and not hasattr(first.Mine, "number")


IMPORT = "from scenes.script.scene import Scene"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "my.py: has no SCENE. Let it say SCENE = Scene"),
        ("SCENE = 'press'", "my.py: its SCENE is a str. Make it a scenes.Scene."),
        ("\nSCENE = Scene(", r"my.py, line 2: is not valid Python \('\(' was never closed\). Correct the file."),
        ("one = 1\nSCENE = one / 0\n", "my.py, line 2: raised ZeroDivisionError: division by zero. Correct the file."),
        ("import no_such_module", "line 1: raised ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise SystemExit(3)", "line 1: raised SystemExit: 3"),
        ("def f():\n    raise ValueError('deep')\nf()", "line 2: raised ValueError: deep"),
        ("x = '\0'", "my.py: is not valid Python|my.py, line 1: is not valid Python"),
        (
            "from sim.material import Material\n\nMaterial('linear', 3000.0, 0.5)",
            r"my.py, line 3: Poisson's ratio is 0.5: give a number",
        ),
        (
            f"{IMPORT}\nSCENE = Scene('a', '', duration=1e12)",
            r"line 2: the scene a lasts 1e\+12 s at 30 frames a second: that is more than 108,000 frames\.",
        ),
        (f"{IMPORT}\nSCENE = Scene('a', '', duration='long')", "line 2: the scene a has duration 'long': give"),
        (f"{IMPORT}\nSCENE = Scene('a', '', frames_per_second=0)", "has frames_per_second 0: give a number above 0"),
        (f"{IMPORT}\nSCENE = Scene('a', '', lambda t: None)", "my.py: at 0 s its path gives a NoneType. Make it a"),
        (f"{IMPORT}\nSCENE = Scene('a', '', lambda t: 1 / t)", "my.py, line 2: raised ZeroDivisionError"),
    ],
)
def test_file_without_a_scene_is_rejected(tmp_path, text, words):
    path = tmp_path / "my.py"
    path.write_text(text)
    modules = set(sys.modules)
    with pytest.raises(InputError, match=words):
        find_scene(str(path))
    if text and "SCENE = 'press'" not in text and "lambda" not in text:  # those that ran stay
        assert not {name for name in set(sys.modules) - modules if name.startswith("own_my")}


def test_missing_scene_file_is_rejected(tmp_path):
    with pytest.raises(InputError, match=r"none\.py: cannot be read \(No such file or directory\)"):
        find_scene(str(tmp_path / "none.py"))
    with pytest.raises(InputError, match=r"'dance'.*MY_SCENE\.py"):
        find_scene("dance")


def test_render_rejects_failing_script_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.py").write_text("SCENE = 1 / 0")
    assert main(["render", "my.py", "--out", "frames"]) == 2
    error = capsys.readouterr().err
    assert "line 1: raised ZeroDivisionError" in error and "Traceback" not in error
    assert [path.name for path in tmp_path.iterdir()] == ["my.py"]
