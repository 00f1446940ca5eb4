"""`python -m benchmarks throughput`: a row for each tissue and preset, with counts and times."""

import json
from dataclasses import replace

import pytest
from conftest import make_box

from benchmarks.__main__ import main
from benchmarks.studies.robustness import SolverTrial
from benchmarks.studies.throughput import ThroughputRow, combine_rows, measure_rates, sample_loads, select_checked
from sim.bodies.meshfile import write_anatomy
from sim.deformation import Outcome
from sim.fem import Fem
from sim.material import BRAIN

ROW = ThroughputRow(
    law="linear",
    poisson=0.45,
    element="p1",
    nodes=99,
    preconditioner="sparse factor",
    set_up=1.0,
    preset="bipolar",
    loads=60,
    converged=60,
    steps_median=4.0,
    steps_p99=7.0,
    seconds=(9.0, 2.0, 3.0),
    draw_seconds=0.1,
    checked=4,
    double=9e-5,
)


@pytest.fixture(scope="module")
def box():
    """Coarser than the shared one."""
    return make_box(cells=(8, 8, 5), spacing=9e-3)


@pytest.fixture(scope="module")
def words(tmp_path_factory, box):
    """The command on the box."""
    path = tmp_path_factory.mktemp("throughput") / "box.vtu"
    write_anatomy(path, box)
    return ["throughput", "--anatomy", str(path), "--device", "cpu", "--laws", "stable-neo-hookean"]


def test_throughput_prints_a_row_for_each_tissue_and_preset(words, capsys):
    few = ["--presets", "bipolar", "mixed", "--count", "6", "--batch", "4", "--repeats", "2"]
    assert main([*words, *few, "--poisson", "0.4", "0.45", "--json"]) == 0
    captured = capsys.readouterr()
    said = json.loads(captured.out)
    sets = [(row["poisson"], row["preset"]) for row in said["rows"]]
    assert sets == [(nu, preset) for nu in (0.4, 0.45) for preset in ("bipolar", "mixed")]
    for row in said["rows"]:
        assert (row["law"], row["element"], row["preconditioner"]) == (
            "stable-neo-hookean",
            "smoothed",
            "sparse factor",
        )
        assert row["nodes"] == 9 * 9 * 6 and row["loads"] == row["converged"] == 6
        assert len(row["seconds"]) == 2 and min(*row["seconds"], row["draw_seconds"], row["set_up"]) > 0.0
        assert row["rate"] == pytest.approx(12 / sum(row["seconds"]))
        assert 1 <= row["steps_median"] <= row["steps_p99"]
        # Solved again, and judged in double precision: not zero, and not over the tolerance but for round-off.
        assert row["checked"] == 4 and 1e-9 < row["double"] < 1.1e-4
    assert [(one["poisson"], one["presets"], one["loads"]) for one in said["tools"]] == [
        (0.4, ["bipolar"], 6),
        (0.45, ["bipolar"], 6),
    ]
    assert captured.err.count("| stable-neo-hookean |") == 4
    assert "preconditioner: sparse factor; batches of at most 4" in captured.err
    assert captured.err.count("the tools together (bipolar): 6 loads in") == 2


def test_two_devices_each_solve_all_loads_concurrently(words, capsys):
    """Twice the loads, each checked; the rate is that of all loads over one clock."""
    few = [
        "--presets",
        "bipolar",
        "--count",
        "5",
        "--repeats",
        "2",
        "--poisson",
        "0.4",
        "--device",
        "cpu,cpu",
        "--json",
    ]
    assert main([*words, *few]) == 0
    captured = capsys.readouterr()
    (row,) = json.loads(captured.out)["rows"]
    assert (row["devices"], row["loads"], row["converged"], row["checked"]) == (2, 10, 10, 8)
    assert row["rate"] == pytest.approx(20 / sum(row["seconds"])) and 1e-9 < row["double"] < 1.1e-4
    assert "; at once on cpu, cpu" in captured.err and "2 processes, each with all loads of a set" in captured.err
    assert "Warp 1" not in captured.out


def test_throughput_measures_ball_poses(words, capsys):
    few = ["--poses", "--presets", "palpation", "bipolar", "--count", "3", "--repeats", "1", "--poisson", "0.4"]
    assert main([*words, *few, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["preset"], row["loads"], row["converged"]) for row in said] == [("palpation", 3, 3), ("bipolar", 3, 3)]
    assert all(1e-9 < row["double"] < 1.1e-4 for row in said)
    assert main([*words, *few[:2], "spatula"]) == 2
    assert "no ball stands for the preset spatula" in capsys.readouterr().err


def test_unconverged_loads_are_counted_with_exit_code_1(words, monkeypatch, capsys):
    """Without a tool preset there is no sum over the tools."""
    deform = Fem.deform

    def failing(fem, loads, **at):
        return replace(deform(fem, loads, **at), outcome=len(loads) * (Outcome.BUDGET,))

    monkeypatch.setattr(Fem, "deform", failing)
    assert main([*words, "--presets", "brutal", "--poisson", "0.45", "--count", "2", "--repeats", "1"]) == 1
    text = capsys.readouterr().out
    assert "| brutal | 2 | 0 |" in text
    assert "set-up" in text and "tools together" not in text


def test_rate_uses_the_median_repeat():
    assert (ROW.median, ROW.rate) == (3.0, 20.0)


def test_only_tool_presets_are_summed():
    others = [replace(ROW, preset=preset, seconds=(1.0,)) for preset in ("mixed", "seed", "brutal")]
    stiff = replace(ROW, poisson=0.49, set_up=2.0)
    found = [ROW, replace(ROW, preset="spatula", loads=40, seconds=(17.0,)), *others, stiff]
    soft, other = combine_rows(found)
    assert (soft.presets, soft.loads, soft.seconds, soft.rate) == (("bipolar", "spatula"), 100, 20.0, 5.0)
    assert (other.poisson, other.set_up, other.rate) == (0.49, 2.0, 20.0)
    assert [one.rate for one in combine_rows(others)] == [None]


def test_one_percent_of_loads_is_checked_in_double_precision(box):
    assert [len(select_checked(count)) for count in (3, 11, 400, 1101)] == [3, 4, 4, 12] and select_checked(1101)[
        -1
    ] == 1100
    reported = []
    sets = sample_loads(box, ["bipolar"], 11)
    (row,) = measure_rates(SolverTrial(box, (), "p1", "cpu", 11), BRAIN, sets, 1, lambda: reported.append(1))
    assert (row.loads, row.checked, len(reported)) == (11, 4, 3)


def test_strained_converged_loads_are_counted_as_converged(box):
    soft = BRAIN.replace_constants(600.0)
    (row,) = measure_rates(
        SolverTrial(box, (), "p1", "cpu", 12), soft, sample_loads(box, ["brutal"], 12), 1, lambda: None
    )
    assert row.converged == row.loads == 12


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        (["--count", "0"], "--count is 0"),
        (["--batch", "0"], "--batch is 0"),
        (["--repeats", "0"], "--repeats is 0"),
        (["--poisson", "0.5"], "Poisson"),
        (["--device", "abacus"], "abacus"),
        (["--device", "cpu,abacus"], "abacus"),
        (["--anatomy", "none.vtu"], "no such file"),
    ],
)
def test_throughput_bench_rejects_invalid_input(words, more, reason, capsys):
    assert main([*words, *more]) == 2
    captured = capsys.readouterr()
    assert reason in captured.err and not captured.out
