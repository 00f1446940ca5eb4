"""Frames of an episode solved again after their history: changed frames are named."""

import os
import signal
import time

import h5py
import pytest

from scenes.episodes.make import make_body, make_episode
from scenes.episodes.plan import load_plan
from scenes.episodes.reading.repeated_frames import solve_frames_again, validate_files
from scenes.episodes.reading.validation import Report, validate_episode
from sim.bodies.meshfile import write_anatomy

PLAN = """
title = "A box"
seconds = 1
frames_per_second = 5
size = [64, 48]
[motion.{family}]
{numbers}
[bodies]
anatomies = "box.vtu"
[bodies.learner]
name = "none"
"""
FAMILIES = {"palpate": "depth_mm = 5", "retract": "depth_mm = 5", "debulk": "fluid = 0.2\nsteps = 2"}


@pytest.fixture(scope="module", params=FAMILIES)
def episode(request, small_box, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    write_anatomy(folder / "box.vtu", small_box)
    (folder / "plan.toml").write_text(PLAN.format(family=request.param, numbers=FAMILIES[request.param]))
    plan = load_plan(str(folder / "plan.toml"))
    assert not make_body(folder, plan, 1, 0, "cpu").failed
    made = make_episode(folder, plan, 1, 0, "cpu")
    assert not made.failed
    return made.path


def test_repeated_solution_detects_a_changed_frame(episode):
    """Only the changed one of frames 0, 2 and 5 is named."""
    report = solve_frames_again(Report(episode), 3, "cpu")
    assert report.problems == [] and report.again == 3 and report.again_mm < 0.1
    with h5py.File(episode, "a") as file:
        file["tumour_fem"][2, 0, 2] += 4e-4
    (said,) = solve_frames_again(Report(episode), 3, "cpu").problems
    assert said.startswith("frame 2, solved again: 0.")


def slow(path):
    """What takes long."""
    time.sleep(0.5)
    return Report(path)


def test_closing_validation_waits_for_started_files_only(tmp_path):
    reports = validate_files([tmp_path / f"{number}.h5" for number in range(200)], 1, slow)
    assert next(reports).problems == []
    began = time.perf_counter()
    reports.close()
    assert time.perf_counter() - began < 20.0  # of a hundred seconds


def end(path):
    """What a damaged file may do to the library that reads it."""
    if "broken" in path.name:
        os.kill(os.getpid(), signal.SIGKILL)
    return validate_episode(path)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_crash_on_one_file_does_not_affect_other_files(whole, tmp_path):
    broken = tmp_path / "broken.h5"
    broken.write_bytes(whole.read_bytes())
    reports = {report.path: report for report in validate_files([broken, whole], 1, end)}
    assert "reading it crashes the process" in reports[broken].problems[0] and not reports[whole].problems
