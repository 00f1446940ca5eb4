"""Locked or unwritable files of a data set: each gives a message."""

import errno
import fcntl
import os
from pathlib import Path

import pytest
from tiny_episodes import Wanted, write_episode

from scenes.episodes.rates import write_rates
from scenes.episodes.reading.contents import open_episode
from scenes.episodes.reading.validation import validate_episode
from scenes.episodes.run_folder import RunSettings, begin_run
from sim.errors import InputError

PLAN = 'title = "A box"\n[motion.press]\n[bodies]\nanatomies = "box.vtu"\n[bodies.learner]\nname = "none"\n'


def fails(*_, **__):
    raise OSError(errno.EPERM, os.strerror(errno.EPERM))


def test_locked_episode_file_is_reported(box, tmp_path):
    path = write_episode(tmp_path / "episode_000000.h5", box, Wanted(3, every=2))
    with path.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)  # as HDF5 does where it writes
        (said,) = validate_episode(path).problems
        assert said.startswith("is locked: another program has it open for writing. Close it there")
        with pytest.raises(InputError, match=r"episode_000000.h5: is locked: another program"):
            open_episode(path)
    assert validate_episode(path).problems == []


def test_folder_without_write_access_is_reported(tmp_path, monkeypatch):
    run = RunSettings("own", "0", 1, "cpu", {})
    begin_run(tmp_path / "set", run, PLAN)
    with monkeypatch.context() as held:
        held.setattr(Path, "open", fails)
        with pytest.raises(InputError, match=r"rates.*cannot be written"), write_rates(tmp_path / "set"):
            pass
    monkeypatch.setattr(Path, "mkdir", fails)
    with pytest.raises(InputError, match=r"set: cannot be written to"):
        begin_run(tmp_path / "set", run, PLAN)
