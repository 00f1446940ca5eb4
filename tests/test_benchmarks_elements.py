"""Element benchmarks: their statistics, and resuming of an interrupted trial."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from theatres import coarse_brain

from benchmarks.__main__ import main
from benchmarks.studies import contact_mesh, stages
from benchmarks.studies.elements import ElementRow, PressCase, extrapolate_motions, measure_motions
from benchmarks.studies.robustness import SETS, LoadRecord, SolverTrial, divide_loads, solve_loads, summarise_sets
from scenes.analysis import measurement
from sim.bodies.meshfile import write_anatomy
from sim.bodies.refine import refine
from sim.deformation import Outcome
from sim.effects import Elasticity, Held, Slide, ToolForce
from sim.material import Material
from sim.runtime.journal import RECORD_MARK


@pytest.fixture(scope="module")
def anatomy():
    return coarse_brain()


def test_timing_statistics_exclude_warm_up(monkeypatch):
    """Simulated clock: 100 s for each warm-up call, then 1, 2, ... 20 s."""
    now, calls = [0.0], []
    monkeypatch.setattr(measurement.time, "perf_counter", lambda: now[0])

    def work(run):
        now[0] += 100.0 if len(calls) < stages.WARM_UP else run + 1.0
        calls.append(run)

    row = stages.time_runs("it", "ms", 1e3, 20, "how", work)
    assert calls[stages.WARM_UP :] == list(range(20)) and set(calls) == set(range(20))
    assert (row.median, row.p95, row.runs) == (pytest.approx(10.5e3), pytest.approx(19.05e3), 20)


def test_nearly_incompressible_tissue_locks_only_p1_elements():
    """Nearly incompressible tissue: P1 elements lose half of the motion, the others little."""
    anatomy = make_box(cells=(6, 6, 4), spacing=12e-3, tumour=12e-3, opening=45e-3)
    press = PressCase(law="linear", force=0.02, footprint=12e-3)
    found = list(measure_motions([anatomy], ["p1", "smoothed"], [0.495], press, "cpu"))
    found += measure_motions([anatomy, refine(anatomy)], ["p2"], [0.495], press, "cpu")
    assert all(row.good for row in found)
    limit = extrapolate_motions(found)[0.495]
    share = {row.element: row.motion / limit for row in reversed(found)}
    assert share["p1"] < 0.5
    assert 0.8 < share["p2"] < 1.0
    assert 0.8 < share["smoothed"] < 1.05


def test_p2_contact_force_depends_less_on_mesh_than_p1():
    anatomy = make_box(cells=(5, 5, 3), spacing=8e-3, tumour=12e-3, opening=34e-3)
    stiff, exact = contact_mesh.measure_forces(
        anatomy, ["p1", "p2"], [2e-3], 8e-3, Material("neo-hookean", 3000.0, 0.45), "cpu"
    )
    assert stiff.along.shape == stiff.fine.shape == (5,) and stiff.depth == 2e-3
    assert (
        0.0 < exact.relative_excess < stiff.relative_excess
        and exact.along.mean() < stiff.fine.mean() < stiff.along.mean()
    )
    assert (
        0.0 < exact.sideways.max() < stiff.sideways.max() < stiff.along.min()
        and stiff.relative_range > exact.relative_range
    )
    known = replace(stiff, along=np.array([1.1, 1.3]), fine=np.array([1.0, 1.0]))
    assert known.relative_excess == pytest.approx(0.2) and known.relative_range == pytest.approx(0.2 / 1.2)


def test_limit_is_extrapolated_with_second_order_error():
    row = ElementRow(
        poisson=0.45, element="p2", vertices=1000, nodes=7000, motion=0.0, set_up=1.0, solve=1.0, outer=4, good=True
    )
    series = [replace(row, vertices=n, motion=2.0 - 3.0 * n ** (-2.0 / 3.0)) for n in (1000, 8000, 27000)]
    assert extrapolate_motions(series) == {0.45: pytest.approx(2.0)}
    assert extrapolate_motions(series[:1]) == {}
    assert extrapolate_motions([replace(one, element="p1") for one in series]) == {}
    assert extrapolate_motions([series[0], replace(series[1], good=False)]) == {}


def test_load_shares_are_half_brutal_and_sum_to_count():
    for count in (2, 7, 60, 10_000):
        assert sum(divide_loads(count).values()) == count
        assert divide_loads(count)["brutal"] == count // 2
    assert list(divide_loads(100)) == list(SETS)


def test_tally_counts_recorded_outcomes():
    one = LoadRecord(
        preset="brutal",
        number=0,
        force=1.0,
        footprint=5e-3,
        outcome="CONVERGED",
        outer=4,
        residual=1e-5,
        double=np.nan,
        seconds=0.1,
    )
    found = [
        one,
        replace(one, outer=40, double=3e-5),
        replace(one, outcome="CONVERGED_IN_STEPS", outer=90, double=8e-5),
        replace(one, outcome="BUDGET", outer=60, residual=0.3, force=0.7),
        replace(one, outcome="STALLED", outer=80, residual=0.1),
    ]
    (tally,) = summarise_sets(found)
    assert (tally.loads, tally.converged, tally.rescued) == (5, 3, 1)
    assert (tally.checked, tally.double) == (2, 8e-5)
    assert tally.hardest == found[3]
    assert summarise_sets(found[:3])[0].hardest == found[2]
    assert all(Outcome[record.outcome] for record in found)


def test_interrupted_robustness_trial_resumes(tmp_path, capsys):
    write_anatomy(tmp_path / "brain.vtu", make_box((7, 7, 4), 8e-3, depth=18e-3))
    words = ["robust", "--anatomy", str(tmp_path / "brain.vtu"), "--count", "12", "--batch", "4"]
    out = tmp_path / "loads.csv"
    assert main([*words, "--out", str(out), "--json"]) == 0
    sets = json.loads(capsys.readouterr().out)["sets"]
    assert sum(item["converged"] for item in sets) == 12
    whole, rows = out.read_text().splitlines(), out.with_suffix(".rows")
    # The header, and the first seven loads: the rest is solved again, with the load whose record a kill tore.
    kept = rows.read_bytes().split(RECORD_MARK)
    rows.write_bytes(RECORD_MARK.join(kept[:9]) + RECORD_MARK + kept[9][:40])
    assert main([*words, "--out", str(out)]) == 0
    again = out.read_text().splitlines()
    assert again[:8] == whole[:8]
    assert [line.split(",")[:6] for line in again] == [line.split(",")[:6] for line in whole]
    assert "| brutal | 6 | 6 (100.00%) |" in capsys.readouterr().out
    assert main([*words, "--seed", "1", "--out", str(out)]) == 2
    assert "was begun with seed 0, but now seed is 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["robust", "--count", "1"], "--count 1"),
        (["robust", "--batch", "0"], "--batch 0"),
        (["robust", "--out", "loads.txt"], ".csv"),
        (["robust", "--anatomy", "none.vtu"], "no such file"),
        (["elements", "none.vtu"], "no such file"),
        (
            ["stages", "palpate"],
            "in the scene palpate no tool pushes, which is what is measured: choose press, slide, draw.",
        ),
    ],
)
def test_element_benches_reject_invalid_input(words, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*words]) == 2
    assert reason in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_random_surgical_and_brutal_loads_converge(anatomy):
    """Half of the loads are far above surgical ones; template to 1e-4 in single precision."""
    effects = (Elasticity(), Held(), Slide(), ToolForce())
    found = [
        record for some in solve_loads(SolverTrial(anatomy, effects, "p1", "cpu", 30), 60, 1, ()) for record in some
    ]
    assert len(found) == 60
    assert [record for record in found if not Outcome[record.outcome].good] == []
    assert max(record.residual for record in found) <= 1e-4
    checked = [record.double for record in found if np.isfinite(record.double)]
    assert len(checked) == len(SETS)
    # What is left of round-off: single precision judges itself a little too well.
    assert max(checked) <= 1.1e-4


def test_contact_bench_prints_its_column_descriptions(tmp_path, capsys):
    path = tmp_path / "box.vtu"
    write_anatomy(path, make_box(cells=(5, 5, 3), spacing=8e-3, tumour=12e-3, opening=34e-3))
    words = ["contact", "--anatomy", str(path), "--device", "cpu", "--elements", "p1", "--ball", "8"]
    assert main([*words, "--depths", "2"]) == 0
    said = capsys.readouterr().out
    head, row = (
        re.findall(r"\|([^|]+)", line) for line in said.splitlines() if line.startswith("| ") and "--" not in line
    )
    assert len(head) == len(row) == 8 and all(f"\n{name.strip()}: " in said for name in head[3:7])
    assert main([*words, "--depths", "2", "0"]) == 2
    assert "--depths" in capsys.readouterr().err
