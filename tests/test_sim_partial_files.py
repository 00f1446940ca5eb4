"""Partial files of killed processes."""

import os
import subprocess
import sys

from test_scenes_run_folder import PLAN
from tiny_work import tiny_run

from scenes.episodes.engine import list_missing_episodes
from scenes.episodes.run_folder import RunSettings, begin_run, list_finished, read_run, to_episode_name
from sim.runtime.atomic_files import write_atomically
from sim.runtime.partial_files import remove_partial_files


def test_leftovers_of_dead_processes_only_are_removed(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    remove = tmp_path / "probe.h5"
    with write_atomically(remove, ".h5") as partial:
        partial.write_text("mine")
        own = partial.name
        machine = own.split("-")[1]
        names = {
            own: True,
            f".sulcus-{machine}-{dead.pid}-episode_000001.h5": False,
            f".sulcus-00000000-{dead.pid}-episode_000002.h5": True,  # of another machine
            ".sulcus-notes": True,
        }
        for name in names:
            (tmp_path / name).touch()
        (tmp_path / f".sulcus-{machine}-{dead.pid}-0003").mkdir()
        (tmp_path / f".sulcus-{machine}-{dead.pid}-0003" / "body.vtu").touch()
        begin_run(tmp_path, tiny_run(), PLAN)
        assert {name for name, stays in names.items() if stays} == {p.name for p in tmp_path.glob(".*")}
    remove_partial_files(tmp_path, max_age=-1.0)
    assert [path.name for path in tmp_path.glob(".*")] == [".sulcus-notes"]


DECADE = 10 * 365 * 86400.0


def test_leftovers_are_identified_without_file_times(tmp_path, monkeypatch):
    run = RunSettings("own", "0", 1, "cpu", {})
    monkeypatch.setattr("time.time", lambda: 0.0)  # a clock that was set back
    assert begin_run(tmp_path, run, PLAN) and not begin_run(tmp_path, run, PLAN) and read_run(tmp_path) == run
    left = tmp_path / ".sulcus-00000000-1-episode_000001.h5"  # another machine's, unfinished
    for path, time in (
        (tmp_path / to_episode_name(0), 2 * DECADE * 10),
        (tmp_path / to_episode_name(2), 1.0),
        (left, DECADE),
    ):
        path.touch()
        os.utime(path, (time, time))
    remove_partial_files(tmp_path)
    tally, missing = list_missing_episodes(tmp_path, list_finished(tmp_path), range(3), True)
    assert (tally.skipped, missing) == (2, [1]) and left.exists()
