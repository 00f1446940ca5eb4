"""The card of a data set: its table, data sheet and licence."""

import csv
import json
from pathlib import Path

import pytest
from tiny_episodes import write_episode

from scenes import write_card
from scenes.cli import main
from scenes.episodes.exports.card import update_card
from scenes.episodes.run_folder import list_finished


def test_card_lists_episodes_and_failures_of_data_set(folder, tmp_path, capsys):
    (folder / "failed").mkdir(exist_ok=True)
    (folder / "failed/episode_000002.json").write_text("{}")
    run = {
        "format": "sulcus run 1",
        "plan": "tiny",
        "digest": "0",
        "seed": 1,
        "device": "cpu",
        "versions": {"h5py": "3"},
    }
    (folder / "run.json").write_text(json.dumps(run))
    assert main(["convert", str(folder), "--to", "card"]) == 0
    assert "card of 2 episodes written to" in capsys.readouterr().out
    rows = list(csv.DictReader((folder / "episodes.csv").read_text().splitlines()))
    assert [row["frames"] for row in rows] == ["7", "9"] and rows[1]["solved"] == "3"
    assert float(rows[0]["largest_error_mm"]) == pytest.approx(0.1)
    sheet = (folder / "DATASHEET.md").read_text()
    for words in (
        "| slide | 1 | 9 | 3 |",
        "| `force_n` | 0.1 | 1.1 | 2 |",
        "| `site.path` | straight | 2 |",
        "- seed: 0 (in 1)\n- seed: 1 (in 1)",
        "device: cpu; packages: h5py 3",
        "In 2 episodes the files do not give the source of the brain",
        "[press]",
        "0.100 mm",
        "1 could not be made",
    ):
        assert words in sheet
    licence = (folder / "LICENSE.md").read_text()
    assert "CC BY 4.0" in licence and "Louis Collins" not in licence
    described = json.loads((folder / "croissant.json").read_text())
    assert described["conformsTo"][0].endswith("croissant/1.1")
    assert len(write_card(folder)["files"]) == 4  # its own it replaces
    (folder / "LICENSE.md").write_text("mine")
    assert main(["convert", str(folder), "--to", "card"]) == 2 and "--force" in capsys.readouterr().err
    assert (folder / "LICENSE.md").read_text() == "mine"
    assert main(["convert", str(folder), "--to", "card", "--force"]) == 0


def test_card_is_updated_when_episodes_are_added(box, tmp_path, monkeypatch):
    def kept(changed):
        return update_card(tmp_path, list_finished(tmp_path), changed)

    assert kept(True) is None and not list(tmp_path.iterdir())  # no episode is whole
    write_episode(tmp_path / "episode_000000.h5", box)

    def rows():
        return (tmp_path / "episodes.csv").read_text().count("\n") - 1

    assert kept(False) is None and rows() == 1
    made = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir() if path.is_file()}
    with monkeypatch.context() as held:  # the folder was listed once, by who gives the numbers
        for name in ("glob", "iterdir"):
            held.setattr(Path, name, lambda *given: pytest.fail("the folder was listed again"))
        assert update_card(tmp_path, {0}, False) is None
    assert kept(False) is None and len(made) == 5
    assert made == {name: (tmp_path / name).stat().st_mtime_ns for name in made}
    assert kept(True) is None and made["DATASHEET.md"] < (tmp_path / "DATASHEET.md").stat().st_mtime_ns
    write_episode(tmp_path / "episode_000001.h5", box)
    (tmp_path / ".sulcus-00000000-1-episode_000002.h5").write_text("half")
    assert kept(False) is None and rows() == 2
    written = (tmp_path / "DATASHEET.md").stat().st_mtime_ns
    assert kept(False) is None and (tmp_path / "DATASHEET.md").stat().st_mtime_ns == written
    (tmp_path / "croissant.json").unlink()
    assert kept(False) is None and (tmp_path / "croissant.json").exists()
    (tmp_path / "LICENSE.md").write_text("mine")
    assert "is not of a card" in (kept(True) or "") and (tmp_path / "LICENSE.md").read_text() == "mine"
