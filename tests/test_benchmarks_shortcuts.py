"""`python -m benchmarks shortcuts`: equal loads for both solvers, and no row without a shortcut."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.studies import shortcuts
from benchmarks.studies.shortcuts import ShortcutCase, ShortcutRow, list_cases, measure_case
from scenes.script.craniotomy_frame import CraniotomyFrame, build_craniotomy_frame
from sim.accuracy import LIVE, TRAIN
from sim.anatomy import Anatomy
from sim.effects import build_push_effects
from sim.fem import Fem
from sim.material import BRAIN
from sim.strategy.plan import SolverStep
from surrogate.data.tool_loads import draw


@pytest.fixture(scope="module")
def site(box: Anatomy) -> CraniotomyFrame:
    return build_craniotomy_frame(box)


def some(site: CraniotomyFrame, **more) -> ShortcutCase:
    loads = draw("palpation", site.anatomy, 3, 0)
    single = [loads.select(np.array([row])) for row in range(3)]
    effects = build_push_effects(site.anatomy, BRAIN)
    return replace(ShortcutCase("a", "b", SolverStep.LBFGS, single, effects, TRAIN, "p1"), **more)


def test_runs_with_and_without_shortcut_alternate(site: CraniotomyFrame, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, solve = [], Fem.deform

    def heard(fem: Fem, loads, start=None):
        asked.append((fem.plan.uses_lbfgs, loads, start))
        return solve(fem, loads, start)

    monkeypatch.setattr(Fem, "deform", heard)
    row = measure_case(some(site), site, "cpu")
    assert row is not None and row.runs == 2  # the first only warms up
    assert [quick for quick, _, _ in asked] == 3 * [True, False]
    assert all(one is other for (_, one, _), (_, other, _) in zip(asked[::2], asked[1::2], strict=True))
    assert not any(start for _, _, start in asked)
    assert row.ratio == pytest.approx(row.median_without / row.median) and row.total >= row.median > 0.0


def test_runs_without_shortcut_drop_the_warm_start(site: CraniotomyFrame, monkeypatch: pytest.MonkeyPatch) -> None:
    starts, solve = [], Fem.deform

    def heard(fem: Fem, loads, start=None):
        starts.append(start)
        return solve(fem, loads, start)

    monkeypatch.setattr(Fem, "deform", heard)
    assert measure_case(some(site, step=None, accuracy=LIVE, live=True, follows=True), site, "cpu") is not None
    assert starts[:2] == [None, None]
    assert all(len(start.warm) > 0 for start in starts[2::2]) and not any(start.warm for start in starts[3::2])


@pytest.mark.parametrize("step", [SolverStep.FRAME, SolverStep.CONTACT, SolverStep.CLAMPED, SolverStep.STRAINED])
def test_unused_shortcut_has_no_row(site: CraniotomyFrame, step: SolverStep) -> None:
    assert measure_case(some(site, step=step), site, "cpu") is None


def test_every_solver_step_except_newton_is_measured(site: CraniotomyFrame) -> None:
    found = list(list_cases(site, 2, False))
    assert {work.step for work in found} == {None, *SolverStep} - {SolverStep.NEWTON}
    assert all(len(work.loads) == 3 for work in found)
    assert {len(work.loads[0]) for work in found} == {1, shortcuts.BATCH, shortcuts.POSES}


def test_shortcuts_command_prints_the_measured_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = ShortcutRow(
        shortcut="short",
        work="work",
        runs=4,
        median=2.0,
        p95=3.0,
        median_without=5.0,
        p95_without=6.0,
        total=10.0,
        total_without=15.0,
    )
    found = iter([row, None])
    monkeypatch.setattr(shortcuts, "list_cases", lambda *known: [1, 2])
    monkeypatch.setattr(shortcuts, "measure_case", lambda *known: next(found))
    assert main(["shortcuts", "--device", "cpu", "--json"]) == 0
    captured = capsys.readouterr()
    (said,) = json.loads(captured.out)["rows"]
    assert (said["ratio"], said["ratio_of_totals"]) == (2.5, 1.5)
    assert "| short | work | 4 | 2, 3 | 5, 6 | 2.50 | 1.50 |" in captured.err
    assert main(["shortcuts", "--runs", "0"]) == 2
    assert "--runs" in capsys.readouterr().err
