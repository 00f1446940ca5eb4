"""Files of a data set that somebody holds, or that cannot be written: each is a sentence, and clocks decide nothing."""

import errno
import fcntl
import os
from pathlib import Path

import pytest
from tiny_episodes import Wanted, write_episode

from scenes.episodes.engine import find_still_missing
from scenes.episodes.rates import write_rates
from scenes.episodes.reading.contents import open_episode
from scenes.episodes.reading.validation import validate_episode
from scenes.episodes.run_folder import RunSettings, begin, list_finished, read_run, to_episode_name
from sim.errors import InputError
from sim.runtime.partial_files import remove_left_overs

PLAN = 'title = "A box"\n[motion.press]\n[bodies]\nanatomies = "box.vtu"\n[bodies.learner]\nname = "none"\n'
DECADE = 10 * 365 * 86400.0


def fails(*_, **__):
    raise OSError(errno.EPERM, os.strerror(errno.EPERM))


def test_a_file_that_another_holds_is_said_to_be_locked(box, tmp_path):
    path = write_episode(tmp_path / "episode_000000.h5", box, Wanted(3, every=2))
    with path.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)  # as HDF5 does where it writes
        (said,) = validate_episode(path).problems
        assert said.startswith("is locked: another program has it open for writing. Close it there")
        with pytest.raises(InputError, match=r"episode_000000.h5: is locked: another program"):
            open_episode(path)
    assert validate_episode(path).problems == []


def test_a_folder_that_takes_no_files_is_named(tmp_path, monkeypatch):
    run = RunSettings("own", "0", 1, "cpu", {})
    begin(tmp_path / "set", run, PLAN)
    with monkeypatch.context() as held:
        held.setattr(Path, "open", fails)
        with pytest.raises(InputError, match=r"rates.*cannot be written"), write_rates(tmp_path / "set"):
            pass
    monkeypatch.setattr(Path, "mkdir", fails)
    with pytest.raises(InputError, match=r"set: cannot be written to"):
        begin(tmp_path / "set", run, PLAN)


def test_times_of_files_decide_nothing(tmp_path, monkeypatch):
    run = RunSettings("own", "0", 1, "cpu", {})
    monkeypatch.setattr("time.time", lambda: 0.0)  # a clock that was set back
    assert begin(tmp_path, run, PLAN) and not begin(tmp_path, run, PLAN) and read_run(tmp_path) == run
    left = tmp_path / ".sulcus-00000000-1-episode_000001.h5"  # another machine's, unfinished
    for path, time in (
        (tmp_path / to_episode_name(0), 2 * DECADE * 10),
        (tmp_path / to_episode_name(2), 1.0),
        (left, DECADE),
    ):
        path.touch()
        os.utime(path, (time, time))
    remove_left_overs(tmp_path)
    tally, missing = find_still_missing(tmp_path, list_finished(tmp_path), range(3), True)
    assert (tally.skipped, missing) == (2, [1]) and left.exists()
