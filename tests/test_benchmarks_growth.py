"""`python -m benchmarks growth`: rows, the plot, and resuming of a stopped run."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ar.screen import read_png
from benchmarks.__main__ import main
from benchmarks.studies import scaling
from benchmarks.studies.scaling import (
    LOADS,
    MeshTrial,
    ScalingRow,
    build_panels,
    build_template_mesh,
    measure_mesh,
    measure_meshes,
)
from sim.errors import InputError

ROW = ScalingRow(
    size=2000,
    asked=1,
    nodes=1977,
    tets=8987,
    preconditioner="sparse factor",
    batch=1,
    set_up=1.0,
    load=0.05,
    outer=8.0,
    loads=12,
    converged=12,
    memory=0.3,
    card=0.0,
    foreseen=0.0,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the smallest template's mesh is kept."""
    folder = tmp_path_factory.mktemp("growth")
    build_template_mesh(folder, 2000)
    return folder


def test_growth_row_describes_the_solved_case(folder):
    row = measure_mesh(MeshTrial("p1", "cpu", folder), 2000, 2)
    assert (row.preconditioner, row.batch, row.loads, row.converged) == ("sparse factor", 2, LOADS, LOADS)
    assert 1900 < row.nodes < 2100 and row.tets > 4 * row.nodes
    assert row.set_up > 0.0 and row.load > 0.0 and row.outer >= 1
    assert 0.05 < row.memory < 20.0 and row.card == row.foreseen == 0.0


def test_recorded_rows_are_not_measured_again(folder, tmp_path, monkeypatch, capsys):
    """The first row comes from the record; the other is measured in a separate process."""
    words = ["growth", "--sizes", "2000", "--batch", "1", "2", "--device", "cpu"]
    out = folder / "growth.png"
    asked = []

    def instead(trial, sizes, batches, done, said):
        asked.append([row.asked for row in done])
        yield from (replace(ROW, asked=b, batch=b) for b in batches if b not in asked[-1])

    monkeypatch.setattr(scaling, "measure_meshes", instead)
    assert main([*words[:-3], "--device", "cpu", "--out", str(out)]) == 0
    assert main([*words, "--out", str(out), "--json"]) == 0
    assert asked == [[], [1]]
    said = capsys.readouterr().out
    assert "| 12 of 12 | 0.3 |  |  |\n" in said  # without a card nothing of it is taken, nor foreseen
    assert f"{out}: written; its rows are in {out.with_suffix('.csv')}" in said
    captured = json.loads(said.splitlines()[-1])
    assert [row["batch"] for row in captured["rows"]] == [1, 2]
    assert read_png(out).std() > 5.0
    monkeypatch.undo()
    assert len((folder / "growth.csv").read_text().splitlines()) == 3
    assert main([*words, "--out", str(out)]) == 0
    assert main([*words, "--element", "p2", "--out", str(out)]) == 2
    assert "was begun with element smoothed" in capsys.readouterr().err
    out.with_suffix(".rows").unlink()
    assert main([*words, "--out", str(out)]) == 2
    assert "growth.png: exists. Give --force" in capsys.readouterr().err


def test_child_process_error_is_raised_in_the_parent(folder):
    """An error in the process is raised unchanged in the parent."""
    said = []
    with pytest.raises(InputError, match="no element"):
        list(measure_meshes(MeshTrial("abacus", "cpu", folder), [2000], [1], [], said.append))
    assert said == ["2000 nodes, the mesh", "2000 nodes, batch of 1"]


def test_plot_marks_the_change_of_preconditioner():
    large = replace(ROW, size=8000, nodes=8000, preconditioner="algebraic multigrid, 3 levels")
    larger = replace(large, nodes=32000, preconditioner="algebraic multigrid, 4 levels")
    seconds, memory = build_panels([ROW, large, larger])
    assert seconds.marks == memory.marks == ((pytest.approx(np.sqrt(1977 * 8000)), "algebraic multigrid"),)
    assert [curve.name for curve in seconds.curves] == ["one load", "set-up"]
    assert [curve.name for curve in memory.curves] == ["host, batch of 1"]
    assert "card, batch of 1" in [curve.name for curve in build_panels([replace(ROW, card=2.0)])[1].curves]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--sizes", "3"], "3 nodes"),
        (["--batch", "0"], "--batch is 0"),
        (["--device", "abacus"], "abacus"),
        (["--out", "growth.txt"], ".png"),
    ],
)
def test_growth_bench_rejects_invalid_input(words, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["growth", *words]) == 2
    assert reason in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
