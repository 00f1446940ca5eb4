"""Datasheets of episodes."""

import json

import h5py
from tiny_episodes import write_episode

from scenes import write_card
from scenes.cli import main
from scenes.episodes.exports.datasheet import format_counts


def test_datasheet_lists_most_frequent_values_first():
    lines = list(format_counts("tool", ["a", "b", "b", *map(str, range(20))]))
    assert lines[:2] == ["- tool: b (in 2)", "- tool: a (in 1)"] and lines[-1] == "- tool: 10 others (in 10)"
    assert list(format_counts("tool", ["a"])) == ["- tool: a (in 1)"]


def test_datasheet_states_anatomy_and_deformer(box, tmp_path):
    path = write_episode(tmp_path / "in/episode_000000.h5", box)
    drawn = {"bodies.anatomies": "template", "bodies.tumour.radius_mm": 12.0, "force_n": 0.2}
    with h5py.File(path, "a") as file:
        file.attrs.update({"parameters": json.dumps(drawn), "deformer": "fem"})
    write_card(path.parent)
    sheet = (path.parent / "DATASHEET.md").read_text()
    assert "the brain is the ICBM 152 template's" in sheet and "FEM was used directly in 1 of the episodes" in sheet
    assert "error of the model" not in sheet and "radius_mm" not in sheet and "from least to greatest" not in sheet
    assert "McGill" in (path.parent / "LICENSE.md").read_text()
    other = write_episode(tmp_path / "other/episode_000000.h5", box)
    (other.parent / "LICENSE.md").write_text("mine")
    for name, given in (("one", [path]), ("two", [path, other])):
        assert main(["convert", *map(str, given), "--to", "folder", "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "one/DATASHEET.md").read_text() == sheet and (tmp_path / "two/DATASHEET_0.md").is_file()
    assert (tmp_path / "two/LICENSE_1.md").read_text() == "mine"
