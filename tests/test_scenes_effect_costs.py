"""Costs of the effects: the record of the template, and the costs that the page shows and measures."""

import json
import threading
from dataclasses import replace

import pytest
from theatres import short, template_theatre

from scenes.page.background_study import BackgroundStudy
from scenes.page.effect_costs import EFFECT_COSTS, METRICS, build_effect_switches, format_switch_label, measure_costs
from scenes.page.requests import Requests
from scenes.play.effect_ablation import ALL, AblationRow, build_record, list_switchable_effects
from scenes.play.effect_record import FORMAT, SUFFIX, read_effect_records, write_effect_record
from scenes.script.scene import SCENES, find_scene
from scenes.script.shipped_files import get_template_path
from scenes.script.tool_paths import Touch
from sim.errors import InputError
from sim.material import Material

ROWS = AblationRow(ALL, 240.04, 1.0, 4.3, 5.0), AblationRow("ToolForce", 180.0, 1.0, 4.25, 5.0)


@pytest.fixture(scope="module")
def template():
    return replace(template_theatre(), effect_records=read_effect_records(get_template_path().with_suffix(SUFFIX)))


def words_of(theatre, scene):
    fold = build_effect_switches(theatre, scene, Requests("fem", Touch()), print)
    return {control.label: control.text for control in fold.controls}


def test_measure_costs_measures_each_switchable_effect(theatre):
    shown, scene = [], short()
    costs = BackgroundStudy(lambda: measure_costs(theatre, scene), threading.Lock(), shown.append)
    costs.start()
    costs.thread.join(120.0)
    assert len(shown) == 2 + len(list_switchable_effects(scene, theatre.anatomy)) == 3
    assert shown[-1]["ToolForce"].startswith("push of the tool: +") and list(shown[1]) == [EFFECT_COSTS]
    notes = [said[EFFECT_COSTS] for said in shown]
    assert "left to measure: 1" in notes[1] and "left to measure: 0" in notes[2] and METRICS in notes[2]
    assert "All effects together: " in notes[2] and "Always on: elastic tissue, fixed base of the brain" in notes[2]


@pytest.mark.parametrize("name", SCENES)
def test_template_record_has_each_effect_of_each_scene(template, name):
    """If it fails: `sulcus effects --out scenes/data/template.effects.json`."""
    scene = find_scene(name)
    record = template.find_effect_record(scene)
    assert record is not None and set(record.effects) == {ALL, *list_switchable_effects(scene, template.anatomy)}
    assert set(template.effect_records) == set(SCENES)
    words = words_of(template, scene)
    assert record.day in words[EFFECT_COSTS] and record.machine in words[EFFECT_COSTS]
    assert not any("not measured" in said for said in words.values())


def test_cost_record_is_shown_for_same_scene_and_anatomy_only(template, theatre):
    scene = find_scene("press")
    stiffer = scene.replace_tissue(Material("linear", young=4000.0, poisson=0.49), None)
    records = template.effect_records
    for other, changed in ((template, stiffer), (replace(theatre, effect_records=records), scene)):
        words = words_of(other, changed)
        assert words["ToolForce"] == "push of the tool: not measured" and "not measured" in words[EFFECT_COSTS]


def test_cost_record_round_trips(theatre, tmp_path):
    path = tmp_path / "box.effects.json"
    lost = AblationRow("Gravity", refused="it <moves>.", unphysical=2)
    found = build_record(theatre, short(), (*ROWS, lost), 2, "a machine")
    write_effect_record(path, found)
    write_effect_record(path, replace(found, scene="other"))
    read = read_effect_records(path)
    assert list(read) == [found.scene, "other"] and read[found.scene] == found
    assert found.effects == {ALL: (240.04, 4.3), "ToolForce": (180.0, 4.25), "Gravity": (None, None)}
    note = words_of(replace(theatre, effect_records=read), short())[EFFECT_COSTS]
    assert "2 frames have inverted" in note and "Not solvable without gravity and CSF: it &lt;moves&gt;." in note
    assert format_switch_label("Gravity", found.effects) == "gravity and CSF: cannot be disabled"
    assert format_switch_label("ToolForce", found.effects) == "push of the tool: +180 ms, 4.25 mm"


PAIRS = [1.0], [240, None], [[1, 2], [3, 4]], [True, False], [1e300, 1], [1, float("nan")], ["1", "2"]
BAD = (
    *(({"effects": {"ToolForce": pair}}, "damaged|of two") for pair in PAIRS), ({"effects": [[1, 2]]}, "damaged"),
    *(({"frames": frames}, "damaged") for frames in (None, 0, 2.5, True)), ({"unphysical": -1}, "damaged"),
    ({"mark": 5}, "damaged"), ({"machine": None}, "damaged"), ({"machine": "\ud800"}, "UTF-8|damaged"),
    ({"refused": {"Gravity": 1}}, "damaged"), ({"effects": {ALL: 5}}, "damaged"),
)  # fmt: skip


@pytest.mark.parametrize(("change", "reason"), BAD)
def test_damaged_cost_record_is_rejected(tmp_path, change, reason):
    path = tmp_path / "box.effects.json"
    good = {"scene": "press", "mark": "1", "day": "2026", "machine": "m", "frames": 3, "effects": {ALL: [1, 2]}}
    path.write_text(json.dumps({"format": FORMAT, "scenes": [good | change]}))
    with pytest.raises(InputError, match=f"({reason}).*Delete it"):
        read_effect_records(path)
