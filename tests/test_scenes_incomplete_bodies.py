"""Interrupted bodies of data sets: solved loads are kept, and the files have identical bytes."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import make_box
from tiny_work import tiny_run

from scenes.episodes import bodies
from scenes.episodes.incomplete_bodies import DATA, TABLE, has_solved_loads, resume_data_set
from scenes.episodes.make import make_body, to_body_path
from scenes.episodes.plan import load_plan, parse_plan
from scenes.episodes.run_folder import begin_run
from sim.bodies.meshfile import write_anatomy
from sim.errors import InputError
from sim.runtime.partial_files import to_partial_path, to_unfinished_path
from surrogate.data.simulate import simulate

PLAN = """
title = "A box"
[motion.press]
[bodies]
anatomies = "box.vtu"
[bodies.learner]
name = "linear"
loads = 70
"""
KILLED = """
import os, sys
from functools import partial
from pathlib import Path
from scenes.episodes import bodies
from scenes.episodes.make import make_body
from scenes.episodes.plan import load_plan

folder, plan, after = sys.argv[1:]

def noted(done, total):
    if done >= int(after):
        os.kill(os.getpid(), 9)

def trained(*given, **more):
    os.kill(os.getpid(), 9)

bodies.simulate = partial(bodies.simulate, progress=noted)
bodies.train = trained
make_body(Path(folder), load_plan(plan), 1, 0, "cpu")
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    write_anatomy(folder / "box.vtu", make_box(cells=(6, 6, 4), spacing=12e-3))
    (folder / "own.toml").write_text(PLAN)
    return load_plan(str(folder / "own.toml"))


@pytest.fixture(scope="module")
def undisturbed(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    made = make_body(folder, plan, 1, 0, "cpu")
    assert not made.failed and not made.resumed
    return files_of(folder)


@pytest.fixture
def solved(monkeypatch):
    """What each call of `simulate` has solved anew, and how many rows there are."""
    found = []

    def noted(*given):
        rows = 0

        def progress(done, total):
            nonlocal rows
            rows = total

        found.append((simulate(*given, progress=progress).total, rows))

    monkeypatch.setattr(bodies, "simulate", noted)
    return found


def files_of(folder):
    """What a body's folder holds, by name."""
    return {path.name: path.read_bytes() for path in to_body_path(folder, 0).iterdir()}


def killed(folder, plan, after):
    """Make a body in a process that kills itself, with no warning, once so many rows are solved."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    words = [sys.executable, "-c", KILLED, str(folder), str(plan.folder / "own.toml"), str(after)]
    assert subprocess.run(words, env=environment, check=False).returncode == -signal.SIGKILL
    assert not to_body_path(folder, 0).exists()


def test_killed_body_resumes_with_identical_files(plan, undisturbed, solved, tmp_path):
    """Killed during the unit responses, and on another machine after all loads were solved."""
    elsewhere, tmp_path = tmp_path / "elsewhere", tmp_path / "here"
    assert begin_run(tmp_path, tiny_run(), "")
    killed(tmp_path, plan, 64)
    (left,) = to_body_path(tmp_path, 0).parent.iterdir()
    assert not begin_run(tmp_path, tiny_run(), "") and has_solved_loads(left)  # the next run removes what others left
    killed(elsewhere, plan, 10**9)
    made = make_body(tmp_path, plan, 1, 0, "cpu")
    assert made.resumed and not made.failed and files_of(tmp_path) == undisturbed
    ((now, total),) = solved
    assert (total, now) in {(109, 70), (109, 6)}  # 39 unit responses; a batch of 64 loads may have been written
    (other,) = to_body_path(elsewhere, 0).parent.iterdir()
    other.rename(other.with_name(".sulcus-00000000-1-0000"))
    assert make_body(elsewhere, plan, 1, 0, "cpu").resumed and files_of(elsewhere) == undisturbed
    assert solved[1][0] == 0
    for folder, there in ((tmp_path, {"0000"}), (elsewhere, {"0000", ".sulcus-00000000-1-0000"})):
        assert {path.name for path in to_body_path(folder, 0).parent.iterdir()} == there
    left.mkdir()
    begin_run(tmp_path, tiny_run(), "")
    assert not left.exists()  # of a body that is there nobody goes on with it


def full(*given, **more):
    """What stands in for a step that finds no memory, which passes."""
    raise InputError("no memory is left just now") from MemoryError()


def test_tabulated_series_is_reused_after_an_error(plan, tmp_path, monkeypatch):
    """The error occurs after the table is written; the model has the same bytes as without an error."""
    text = plan.text.replace('"linear"', '"series"').replace("loads = 70", "loads = 40")
    again = replace(parse_plan(text, "own", plan.folder), own=plan.own)

    with monkeypatch.context() as held:
        held.setattr(bodies, "save", full)
        with pytest.raises(InputError, match="just now"):
            make_body(tmp_path, again, 1, 0, "cpu")
    with monkeypatch.context() as held:
        held.setattr("surrogate.training.expansion.tabulate_series", full)
        assert make_body(tmp_path, again, 1, 0, "cpu").resumed
    assert not make_body(tmp_path / "other", again, 1, 0, "cpu").resumed
    assert files_of(tmp_path) == files_of(tmp_path / "other")


def test_temporary_error_keeps_solved_loads(plan, undisturbed, solved, tmp_path, monkeypatch):
    with monkeypatch.context() as held:
        held.setattr(bodies, "train", full)
        with pytest.raises(InputError, match="just now"):
            make_body(tmp_path, plan, 1, 0, "cpu")
    partial = to_partial_path(to_body_path(tmp_path, 0))
    assert has_solved_loads(partial)
    (partial / "anatomy.vtu").write_text("half")
    (partial / "other").write_text("half")
    assert make_body(tmp_path, plan, 1, 0, "cpu").resumed and solved[1][0] == 0
    assert files_of(tmp_path) == undisturbed and not partial.exists()


def test_resume_uses_the_most_complete_data_set(tmp_path):
    stated, folders = {"seed": "1"}, [tmp_path / str(number) for number in range(4)]
    for folder, size in zip(folders, (0, 10, 30, 50), strict=True):
        folder.mkdir()
        if size:
            assert not resume_data_set(folder / DATA, {"seed": "2"} if size == 50 else stated, [])
            to_unfinished_path(folder / DATA).write_bytes(bytes(size))
    own = folders[0] / DATA
    assert resume_data_set(own, stated, folders) and to_unfinished_path(own).stat().st_size == 30
    (folders[1] / DATA).write_bytes(b"whole")
    for folder in (folders[1], folders[3]):
        (folder / DATA).with_suffix(TABLE).write_text(folder.name)
    assert resume_data_set(own, stated, folders) and own.read_bytes() == b"whole"
    assert own.with_suffix(TABLE).read_text() == "1"
    assert not resume_data_set(own, {"seed": "3"}, folders) and not has_solved_loads(folders[0])
    assert {path.name for path in folders[0].iterdir()} == {Path(DATA).with_suffix(".json").name}
