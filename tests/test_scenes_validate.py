"""Command that validates episodes."""

import json

import h5py
from tiny_episodes import Wanted, write_episode

from scenes import write_card
from scenes.cli import main
from scenes.episodes.reading.validation import validate_episode


def test_validate_command_names_broken_files_and_exits_with_1(whole, tmp_path, capsys):
    broken = tmp_path / "broken.h5"
    broken.write_bytes(whole.read_bytes()[:3000])
    assert main(["validate", str(whole), "--workers", "1"]) == 0
    out = capsys.readouterr().out
    assert "1 of 1 episodes are whole: 7 frames, 4 of them solved" in out and "maximum 0.100 mm" in out
    assert main(["validate", str(whole), str(broken), "--workers", "1", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["broken"] == 1 and said["files"][1]["path"] == str(broken)
    size, (problem,) = whole.stat().st_size, said["files"][1]["problems"]
    assert f"cannot be read as an episode: it is cut off: 3000 of {size} bytes. Make it again" in problem
    assert "sulcus validate" not in problem
    with h5py.File(broken, "w") as file:
        file.attrs.update({"format": "sulcus episode 2", "width": 40, "height": 30})
    assert validate_episode(broken).problems == ["it has no 'time'. Make it again, or leave it out."]
    assert main(["validate", str(tmp_path / "none.h5")]) == 2 and "no such file" in capsys.readouterr().err
    assert main(["validate", str(whole), "--workers", "0"]) == 2


def test_statistics_use_complete_episodes_and_name_missing_ones(box, tmp_path, capsys):
    for number in range(3):
        write_episode(tmp_path / f"episode_00000{number}.h5", box, Wanted(4 + number, every=1))
    with h5py.File(tmp_path / "episode_000000.h5", "a") as file:
        file["tumour_fem"][...] = file["tumour_predicted"][:] + [0.0, 0.0, 2e-7]
    with h5py.File(tmp_path / "episode_000001.h5", "a") as file:
        file["force"].attrs["unit"] = "mN"
    write_card(tmp_path)
    (tmp_path / "episode_000002.h5").unlink()
    assert main(["validate", str(tmp_path), "--workers", "1"]) == 1
    unit, gone, *_, frames, error = capsys.readouterr().out.splitlines()
    assert "'mN'" in unit and "episode_000002.h5: is gone; episodes.csv lists it" in gone
    assert "1 of 3 episodes are whole: 4 frames, 4 of them solved" in frames
    assert "mean 0.000200 mm, maximum 0.000200 mm" in error
