"""Factorial study of unknown parameters: variance shares of single factors and interactions."""

import csv
import json
from itertools import product

import numpy as np
import pytest

from scenes.analysis import factorial
from scenes.analysis.factorial import LEVELS, FactorCombination, build_panels, compute_variance_shares, solve_levels
from scenes.cli import main

FEW = {
    "opening [mm]": (50.0,), "depth [mm]": (10.0,), "skull": ("bonded", "slide"), "nu": (0.45, 0.49),
    "tumour's stiffness": (1.0,),
}  # fmt: skip


@pytest.fixture(scope="module")
def few():
    return list(solve_levels(FEW, 2000, "cpu"))


def made(rule):
    """Cells of a rule for the motion."""
    levels = {"opening [mm]": (30.0, 50.0), "nu": (0.45, 0.49), "skull": ("bonded", "slide")}
    combinations = [dict(zip(levels, each, strict=True)) for each in product(*levels.values())]
    return [FactorCombination(each, rule(each), 1.0) for each in combinations]


def test_multiplicative_factors_have_no_interaction():
    """The logarithm of the motion is a sum, and so is its variance."""
    found = compute_variance_shares(
        made(lambda at: 2.0 * (3.0 if at["skull"] == "slide" else 1.0) * (np.e if at["nu"] == 0.45 else 1.0))
    )
    a, b = np.log(3.0) ** 2, 1.0
    assert found["skull"] == pytest.approx(a / (a + b)) and found["nu"] == pytest.approx(b / (a + b))
    assert list(found)[:2] == ["skull", "nu"] and max(list(found.values())[2:]) < 1e-12


def test_joint_effect_of_two_factors_is_an_interaction():
    found = compute_variance_shares(made(lambda at: np.e if (at["skull"] == "slide") == (at["nu"] == 0.45) else 1.0))
    assert found["nu x skull"] == pytest.approx(1.0) and next(iter(found)) == "nu x skull"
    assert found["opening [mm]"] == pytest.approx(0.0, abs=1e-12)


def test_variance_shares_ignore_cells_without_convergence():
    found = made(lambda at: np.nan if at["opening [mm]"] == 30.0 else 1.0 + (at["nu"] == 0.45))
    assert "opening [mm]" not in compute_variance_shares(found) and compute_variance_shares(found)[
        "nu"
    ] == pytest.approx(1.0)


def test_factorial_study_solves_each_combination(few):
    assert [(cell.levels["skull"], cell.levels["nu"]) for cell in few] == list(product(FEW["skull"], FEW["nu"]))
    motion = {(cell.levels["skull"], cell.levels["nu"]): cell.force for cell in few}
    assert motion["slide", 0.49] > motion["bonded", 0.49] > 0.1 and motion["bonded", 0.45] > motion["bonded", 0.49]
    default = few[1]
    assert default.levels["nu"] == 0.49 and default.motion == pytest.approx(default.force, rel=1e-2)
    softer = few[0]  # tissue that gives in volume follows a known motion less far than a known force
    assert softer.levels["nu"] == 0.45 and softer.motion < 0.98 * softer.force


def test_factorial_command_writes_table_and_plot(few, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(factorial, "solve_levels", lambda nodes, device: iter(few))
    words = ["sensitivity", "--factorial", "--out", str(tmp_path / "all.csv")]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "| skull " in said and "| nu x skull " not in said and "| skull x nu " in said
    with open(tmp_path / "all.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["force_mm"]) for row in rows] == [cell.force for cell in few]
    assert (tmp_path / "all.png").stat().st_size > 10_000
    assert main([*words[:2], "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["failed"] == 0
    assert main([*words, "--anatomy", "mine.vtu", "--force"]) == 2 and "leave --anatomy out" in capsys.readouterr().err


def test_plot_has_panel_per_opening_and_curve_per_change():
    whole = [FactorCombination(dict(zip(LEVELS, each, strict=True)), 1.0, 1.0) for each in product(*LEVELS.values())]
    drawn = build_panels(whole)
    assert len(drawn) == 3 and [len(panel.curves) for panel in drawn] == [5, 5, 5]
    assert [len(curve.points) for curve in drawn[0].curves] == [3] * 5
    assert all(panel.y_range == (0.8, 1.5) for panel in drawn)  # one scale for all openings
