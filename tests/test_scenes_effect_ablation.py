"""Cost and influence of each effect of a scene."""

import json
import re
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
import warp as wp
from theatres import short, sinking, theatre_of

from scenes.cli import main
from scenes.play.effect_ablation import ALL, build_record, list_arrays, measure_effects, remove_effect, solve_frames
from scenes.play.effect_record import read_effect_records
from scenes.script.scene import find_scene
from sim.bodies.meshfile import write_anatomy
from sim.deformation import Outcome
from sim.effects import Gravity, Held
from sim.errors import InputError
from sim.fem import Fem

pytestmark = pytest.mark.usefixtures("ours_alone")


@pytest.fixture(scope="module")
def small_theatre(small_box):
    return theatre_of(small_box)


@pytest.fixture(scope="module")
def anatomy(box_folder):
    return str(box_folder / "box.vtu")


@pytest.fixture(scope="module")
def printed(small_box, tmp_path_factory):
    """What the command prints of one scene, and what it says beside it."""
    anatomy = str(tmp_path_factory.mktemp("printed") / "small.vtu")
    write_anatomy(anatomy, small_box)
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as error:
        assert main(["effects", "brain_shift", "--anatomy", anatomy, "--every", "60", "--device", "cpu", "--json"]) == 0
    return out.getvalue(), error.getvalue()


def test_remove_effect_removes_one_effect_of_a_scene():
    scene = sinking()
    assert Gravity() not in remove_effect(scene, Gravity()).effects and len(remove_effect(scene, Held()).effects) == 3
    cut = find_scene("resection")
    assert remove_effect(cut, object()).surgery is None and remove_effect(cut, Held()).surgery is not None  # type: ignore


def test_measure_effects_returns_one_row_per_effect(small_theatre):
    both = replace(short(), effects=(*short().effects, Gravity()), lying=sinking().lying)
    found = {row.effect: row for row in measure_effects(small_theatre, both, 1)}
    assert list(found) == [ALL, "Elasticity", "Held", "Bonded", "ToolForce", "Gravity"]
    assert "nothing else resists" in found["Elasticity"].refused and found["Elasticity"].milliseconds is None
    assert "can move rigidly" in found["Held"].refused
    skull = found["Bonded"]  # this body has none
    assert skull.tumour_mm == skull.cortex_mm == 0.0 and not skull.refused
    # Each moves the tumour, both together no farther than the sum.
    push, weight, whole = found["ToolForce"], found["Gravity"], found[ALL]
    assert push.tumour_mm > 0.1 and weight.tumour_mm > 0.1
    assert max(push.tumour_mm, weight.tumour_mm) < whole.tumour_mm < 1.1 * (push.tumour_mm + weight.tumour_mm)
    assert whole.milliseconds > 0.0 and whole.held_mb > 0.1


def test_measured_bytes_are_equal_in_repeated_runs(small_theatre):
    held = [solve_frames(replace(small_theatre, models={}), sinking(), 3).memory_bytes for _ in range(3)]
    assert held[0] == held[1] == held[2] > 100_000
    assert held[0] == pytest.approx(counted(small_theatre, sinking(), 3), rel=0.02)


def counted(theatre, scene, every):
    """Bytes that a scene keeps, counted again: numbers of each array, and the size of a number."""
    before = list_arrays()  # held: the number of an array that goes may be that of a new one
    fem, last = replace(theatre, models={}).build_fem(scene, scene.accuracy, live=True), None
    for time in scene.times[::every].tolist():
        last = fem.deform(scene.build_loads(theatre.site, scene.path(time), time), start=last)
    known = {id(array) for array in before}
    new = [array for array in list_arrays() if id(array) not in known]
    return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in new)


def test_printed_memory_equals_size_of_device_arrays(small_theatre, printed):
    """Each row of table and JSON, against bytes counted without `scenes.play.effect_ablation.rows`."""
    out, error = printed
    table = [[cell.strip() for cell in line.split("|")] for line in error.splitlines() if line.startswith("| ")]
    scene = find_scene("brain_shift")
    whole = counted(small_theatre, scene, 60)
    expected = {ALL: whole, "Gravity": whole - counted(small_theatre, remove_effect(scene, Gravity()), 60)}
    cells = {cells[1]: cells[3] for cells in table}
    reported = {row["effect"]: row["held_mb"] for row in json.loads(out)["effects"]}
    for name, size in expected.items():
        assert reported[name] == pytest.approx(1e-6 * size, rel=0.05) and size > 5_000
        assert float(cells[name]) == pytest.approx(1e-6 * size, rel=0.05, abs=0.005)
    assert {cells[name] for name, held in reported.items() if held is None} == {""}


def test_effect_change_is_difference_between_solutions(small_theatre):
    """Independent check: an effect that causes the whole motion."""
    scene = sinking()
    found = {row.effect: row for row in measure_effects(small_theatre, scene, 2)}
    alone = solve_frames(replace(small_theatre, models={}), scene, 2)
    whole = alone.displacement[:, small_theatre.anatomy.tumour_nodes]
    largest = 1e3 * np.linalg.norm(whole, axis=2).mean(axis=1).max()
    assert found["Gravity"].tumour_mm == found[ALL].tumour_mm == pytest.approx(largest, rel=1e-6)
    assert found[ALL].held_mb == pytest.approx(1e-6 * alone.memory_bytes, rel=0.01)


def test_ablation_rejects_scene_with_unsolved_frame(theatre):
    scene = replace(short(), accuracy=replace(short().accuracy, outer=1, inner=1, steps=0))
    with pytest.raises(InputError, match=r"the frame at 0\.\d+ s is not solved: not converged"):
        solve_frames(theatre, scene, 1)


def test_ablation_counts_frames_with_inverted_elements(small_theatre, monkeypatch):
    solve, inverted = Fem.deform, (Outcome.INVERTED,)
    monkeypatch.setattr(Fem, "deform", lambda *args, **named: replace(solve(*args, **named), outcome=inverted))
    rows = list(measure_effects(small_theatre, short(), 3, ["ToolForce"]))
    assert [(row.effect, row.unphysical) for row in rows] == [(ALL, 3), ("ToolForce", 3)]
    assert build_record(small_theatre, short(), rows, 3, "").unphysical == 6


def test_list_device_arrays_finds_new_array_without_views():
    before = list_arrays()
    array = wp.zeros(1_000_000, dtype=wp.float32, device="cpu")
    view = array[:500_000]
    new = [found for found in list_arrays() if all(found is not known for known in before)]
    assert new == [array] and array.capacity == 4_000_000 and len(view) == 500_000


def test_effects_command_prints_one_row_per_effect(theatre, anatomy, printed, capsys):
    out, error = printed
    reported = json.loads(out)
    asked = [type(effect).__name__ for effect in find_scene("brain_shift").get_effects_on(theatre.anatomy)]
    assert out.count("\n") == 1 and reported["scene"] == "brain_shift"
    assert [row["effect"] for row in reported["effects"]] == [ALL, *asked]
    found = next(row for row in reported["effects"] if row["effect"] == "Gravity")
    cells = [f"{found[name]:.2f}" for name in ("milliseconds", "held_mb", "tumour_mm", "cortex_mm")]
    assert f"| Gravity | {' | '.join(cells)} |" in error and cells[2] != cells[3]
    assert "| effect | ms a frame | MB on the device | tumour mm | cortex mm |" in error
    assert main(["effects", "brain_shift", "--anatomy", anatomy, "--every", "0"]) == 2
    assert "give a whole number" in capsys.readouterr().err


HOPELESS = """
from dataclasses import replace
from scenes.builtin.press import SCENE as press
SCENE = replace(press, name="hopeless", accuracy=replace(press.accuracy, outer=1, inner=1, steps=0))
"""


def test_effects_command_continues_after_unsolved_scene(small_box, tmp_path, capsys):
    write_anatomy(tmp_path / "small.vtu", small_box)
    (tmp_path / "hopeless.py").write_text(HOPELESS)
    record, where = tmp_path / "small.effects.json", ["--anatomy", str(tmp_path / "small.vtu"), "--device", "cpu"]
    asked = ["effects", str(tmp_path / "hopeless.py"), "press", *where, "--every", "60", "--out", str(record)]
    assert main([*asked, "--json"]) == 1
    out, error = capsys.readouterr()
    failed, solved = json.loads(out)["scenes"]
    assert out.count("\n") == 1 and failed["scene"] == "hopeless" and solved["scene"] == "press"
    assert "is not solved" in failed["error"] and f"hopeless: {failed['error']}" in error
    found = read_effect_records(record)
    assert list(found) == ["press"] and list(found["press"].effects) == [ALL, "ToolForce"]
    assert re.fullmatch(rf"{wp.get_device('cpu').name} / \S.*, solver threads: [12]", found["press"].machine)
