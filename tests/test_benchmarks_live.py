"""Benchmark of live frames: tool motion, warm start and measured errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box

from benchmarks.__main__ import main
from benchmarks.studies import live
from benchmarks.studies.live import (
    RIDES,
    WARM_UP,
    LiveFrame,
    ToolRide,
    build_loads,
    compute_errors,
    solve_frames,
    summarise_ride,
)
from scenes.analysis.budget import MAX_LIVE_ERROR
from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.scene import find_scene
from scenes.script.tool_paths import stroke_cortex
from sim.bodies.meshfile import write_anatomy
from sim.deformation import Outcome
from sim.effects import Elasticity, Held, ToolForce
from sim.loads import Pushed

SCENE = replace(find_scene("press"), effects=(Elasticity(), Held(), ToolForce()))


@pytest.fixture(scope="module")
def site():
    return build_craniotomy_frame(make_box(cells=(6, 6, 3), spacing=12e-3, tumour=15e-3, depth=20e-3, opening=40e-3))


def test_tool_path_has_constant_speed_within_circle():
    times = np.arange(0.0, 60.0, 0.01)
    path = stroke_cortex(0.25, 10e-3, 20e-3)
    places = np.array([(touch.x, touch.y) for touch in map(path, times.tolist())])
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
    # A sample that spans a corner is cut short.
    assert np.median(moved) == pytest.approx(0.2e-3)
    assert moved.max() < 0.2e-3 * (1.0 + 1e-9)
    assert (moved < 0.19e-3).mean() < 0.02
    assert np.linalg.norm(places, axis=1).max() < 10e-3 * (1.0 + 1e-9)
    assert path(7.0).force == 0.25
    sector = np.unique(np.floor(np.arctan2(*places.T) / (np.pi / 8.0)))
    assert len(sector) == 16


def test_tool_presses_at_each_path_position(site):
    found = build_loads(RIDES[0], SCENE, site, 20)
    assert len(found) == WARM_UP + 20
    pushed = [load.get(Pushed) for load in found]
    assert all(np.linalg.norm(one.force) == pytest.approx(0.25) for one in pushed)
    steps = np.linalg.norm(np.diff([one.point[0] for one in pushed], axis=0), axis=1)
    assert np.median(steps) == pytest.approx(20e-3 / 30.0, rel=0.01)


def test_frames_start_from_last_result_and_skip_warm_up(site, pretender):
    starts = []

    class Watched:
        def deform(self, loads, start=None):
            starts.append(start)
            return pretender.deform(loads)

    loads = build_loads(RIDES[0], SCENE, build_craniotomy_frame(pretender.anatomy), 3)
    frames = list(solve_frames(Watched(), loads))
    assert [frame.loads for frame in frames] == loads[WARM_UP:]
    assert starts[0] is None and all(start is not None for start in starts[1:])
    np.testing.assert_array_equal(starts[-1].displacement, frames[-2].result.displacement)
    assert all(frame.seconds > 0.0 for frame in frames)


def test_errors_measure_a_known_displacement_error(site):
    fem = live.build_live_fem(SCENE, site, "cpu", "p1")
    load = build_loads(ToolRide("weak", 0.1, 10e-3), SCENE, site, 1)[-1]
    answer = fem.deform(load)
    moved = answer.displacement.copy()
    moved[0, 5] += [0.0, 3e-4, 4e-4]
    off = compute_errors(
        [LiveFrame(load, answer, 0.1), LiveFrame(load, replace(answer, displacement=moved), 0.1)], SCENE, site, "p1"
    )
    assert off[0] < MAX_LIVE_ERROR
    assert off[1] == pytest.approx(5e-4, abs=off[0])


def test_tally_summarises_frame_times_and_outcomes(site, pretender):
    load = build_loads(RIDES[0], SCENE, build_craniotomy_frame(pretender.anatomy), 1)[-1]
    answer = pretender.deform(load)
    frames = [LiveFrame(load, answer, 1e-3 * number) for number in range(1, 101)]
    item = summarise_ride(RIDES[0], frames, np.array([1e-5, 3e-5]))
    assert (item.frames, item.median, item.worst) == (100, pytest.approx(50.5), pytest.approx(100.0))
    assert item.p95 < item.p99 < item.worst
    assert (item.steps, item.most_steps, item.outcomes, item.good) == (4.0, 4, {"CONVERGED": 100}, True)
    assert (item.checked, item.error) == (2, pytest.approx(0.03))
    lost = replace(answer, outcome=(Outcome.STALLED,))
    assert not summarise_ride(RIDES[0], [*frames, LiveFrame(load, lost, 1.0)], np.zeros(1)).good


def test_live_command_reports_every_tool(site, tmp_path, capsys, monkeypatch):
    write_anatomy(tmp_path / "box.vtu", site.anatomy)
    words = ["live", "--anatomy", str(tmp_path / "box.vtu"), "--frames", "3", "--checked", "2"]
    assert main([*words, "--device", "cpu", "--json"]) == 0
    rides = json.loads(capsys.readouterr().out)["rides"]
    assert [item["ride"] for item in rides] == [ride.name for ride in RIDES]
    assert all(item["frames"] == 3 and item["checked"] == 2 and item["error"] <= 0.05 for item in rides)
    monkeypatch.setattr(live, "compute_errors", lambda frames, *rest: np.full(len(frames), 1e-3))
    assert main([*words, "--device", "cpu"]) == 1
    capsys.readouterr()
    assert main([*words[:-2], "--device", "cpu", "--json"]) == 1  # as many are checked as there are
    assert [item["checked"] for item in json.loads(capsys.readouterr().out)["rides"]] == [3] * len(RIDES)
    assert main([*words[:-2], "--device", "cpu"]) == 1
    assert "| palpation | 3 |" in capsys.readouterr().out


def test_live_bench_rejects_invalid_input(tmp_path, capsys):
    assert main(["live", "--frames", "3", "--checked", "4"]) == 2
    assert "--checked 4" in capsys.readouterr().err
    assert main(["live", "--frames", "0"]) == 2
    assert "--frames is 0: give a whole number from 1 up" in capsys.readouterr().err
    write_anatomy(tmp_path / "small.vtu", make_box(opening=9e-3))
    assert main(["live", "--anatomy", str(tmp_path / "small.vtu")]) == 2
    assert "larger craniotomy" in capsys.readouterr().err
