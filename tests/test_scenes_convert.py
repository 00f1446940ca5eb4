"""Conversion of episodes: output folders, interrupted runs and full disks."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest
from tiny_episodes import Wanted, write_episode

from scenes.cli import main
from sim.errors import InputError
from sim.runtime.atomic_files import write_folder_atomically
from sim.runtime.partial_files import to_partial_path


@pytest.mark.parametrize("name", ["lerobot", "folder", "xdmf"])
def test_convert_rejects_non_empty_folder(name, folder, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine").write_text("mine")
    words = ["convert", str(folder), "--to", name, "--out", str(out)]
    assert main(words) == 2 and "not empty" in capsys.readouterr().err
    (out / "mine").unlink()
    assert main(words) == 0 and [path.name for path in tmp_path.iterdir()] == ["out"]


def test_convert_rejects_incompatible_episodes_without_output(folder, box, tmp_path, capsys):
    wide = write_episode(tmp_path / "in/wide.h5", box, Wanted(4, width=48))
    bare = write_episode(tmp_path / "in/bare.h5", box, Wanted(4))
    with h5py.File(bare, "a") as file:
        del file["T_world_tool"]
    for given, words in (([folder, wide], "convert them separately"), ([bare], "has no tool")):
        for name in ("lerobot", "robomimic"):
            out = tmp_path / ("x.hdf5" if name == "robomimic" else "x")
            assert main(["convert", *map(str, given), "--to", name, "--out", str(out)]) == 2
            assert words in capsys.readouterr().err.splitlines()[-1]
    for given in (["--to", "lerobot"], ["--to", "card", "--out", "x"]):
        assert main(["convert", str(folder), *given]) == 2 and "--out" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_interrupted_folder_write_leaves_no_files(tmp_path):
    with pytest.raises(KeyboardInterrupt), write_folder_atomically(tmp_path / "out", 10) as partial:
        (partial / "a").write_text("a")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_partial_folder_of_killed_run_is_removed(tmp_path):
    out, code = tmp_path / "out", (
        "import os, sys; from pathlib import Path; from sim.runtime.atomic_files import write_folder_atomically\n"
        "with write_folder_atomically(Path(sys.argv[1]), 10) as partial: (partial / 'a').mkdir(); "
        "os.kill(os.getpid(), 9)"
    )  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code, str(out)], cwd=Path(__file__).parents[1], check=False)
    (left,) = tmp_path.iterdir()
    assert done.returncode == -9 and (left / "a").exists()
    with write_folder_atomically(out, 10) as partial:
        assert not left.exists()
        with write_folder_atomically(tmp_path / "other", 10):
            assert partial.exists()
    assert {path.name for path in tmp_path.iterdir()} == {"out", "other"}


def test_folder_being_written_by_another_run_is_rejected(tmp_path):
    folder = tmp_path / "out"
    other = to_partial_path(folder).with_name(to_partial_path(folder).name.replace(str(os.getpid()), str(os.getppid())))
    other.mkdir()
    with pytest.raises(InputError, match="another run is writing it"), write_folder_atomically(folder):
        pytest.fail("entered")
    assert list(tmp_path.iterdir()) == [other]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_full_disk_is_reported_and_leaves_no_files(tmp_path):
    with pytest.raises(InputError, match="No space left"), write_folder_atomically(tmp_path / "out", 10) as partial:
        (partial / "a").write_text("a")
        with open("/dev/full", "w") as full:
            full.write("x" * 10_000)
    assert not list(tmp_path.iterdir())
