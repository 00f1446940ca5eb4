"""Figures of report rows without a study: tenths of the force, Pareto front, and rejected input."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box

from scenes.cli import main
from scenes.commands.report import QUICK_COUNTS
from scenes.report.charts import build_error_chart, find_front
from scenes.report.page import Section, write_report
from scenes.report.row import ReportRow, compute_distance_figures, summarise_times
from sim.bodies.meshfile import write_anatomy
from surrogate.data.dataset import read_dataset


def test_errors_are_grouped_by_tenths_of_the_force():
    truth = np.ones((20, 2, 3))
    force = np.arange(20.0)[::-1]
    distance = np.column_stack([force, 3.0 * force]) * 1e-3
    tenths = compute_distance_figures(distance, truth, force).tenths
    assert [(tenth.least, tenth.greatest) for tenth in tenths] == [(2.0 * k, 2.0 * k + 1.0) for k in range(10)]
    assert [tenth.mean for tenth in tenths] == pytest.approx([4.0 * k + 1.0 for k in range(10)])
    assert [tenth.largest for tenth in tenths] == pytest.approx([6.0 * k + 3.0 for k in range(10)])
    assert compute_distance_figures(distance[:0], truth[:0], force[:0]) is None
    worst = compute_distance_figures(distance, truth, force).worst
    assert (worst.mean, worst.p95, worst.largest) == pytest.approx((28.5, 3.0 * np.percentile(force, 95), 57.0))


def test_pareto_front_has_rows_not_dominated():
    figures = compute_distance_figures(np.ones((1, 1)), np.ones((1, 1, 3)), np.ones(1))

    def row(name, time, error, against="error"):
        mm = replace(figures.mm, mean=error)
        return ReportRow(name, "f", against=against, reference=replace(figures, mm=mm), median=time)

    rows = [row("fast", 1.0, 9.0), row("near", 9.0, 1.0), row("between", 3.0, 3.0), row("beaten", 4.0, 3.0)]
    rows += [row("slow", 10.0, 10.0), row("other law", 0.5, 0.5, "model difference")]
    rows += [ReportRow("none", "f", state="it has no bound")]
    assert find_front(rows) == {"fast", "near", "between"}
    chart = build_error_chart(rows)
    assert {dot.name for dot in chart.dots if not dot.is_pale} == {"fast", "near", "between"}
    assert len(chart.front) == 3 and build_error_chart(rows[-1:]) is None


def test_time_summary_has_p99_only_with_1000_values():
    seconds = 1e-3 * np.arange(1.0, 1001.0)
    found = summarise_times(seconds)
    assert found.pop("central_ms") == pytest.approx((25.975, 975.025), rel=1e-3)
    assert found == pytest.approx({"median": 500.5, "p99": np.percentile(1e3 * seconds, 99), "timed": 1000})
    assert summarise_times(seconds[:999])["p99"] is None


def test_report_table_has_values_under_their_headings(tmp_path):
    """Values read from the page: times, memory and reliable loads."""
    one = compute_distance_figures(np.full((4, 2), 1e-3), np.full((4, 2, 3), 1e-2), np.arange(4.0))
    row = ReportRow("svr", "learnt", reference=one, median=1.5, p99=2.5, set_up=3.5, memory=0.25)
    row = replace(row, loads=600, units=60, series=9000, inside=12, solving=180.0, learning=120.0, timed=1000)
    row = replace(row, reference=replace(one, worst=replace(one.worst, mean=7.5)))
    row = replace(row, outcomes={"CONVERGED": 3, "INVERTED": 1}, adapt=70.0)
    write_report(tmp_path, "a machine", [Section("data", (), (row, ReportRow("odd", "f", state="no <memory>")))])
    text = (tmp_path / "index.html").read_text()
    assert "<p>odd: no &lt;memory&gt;</p>" in text
    tables = [
        [re.findall("<t[hd][^>]*>(.*?)</t[hd]>", line) for line in table.split("</tr>")]
        for table in re.findall("<table>(.*?)</table>", text, re.S)
    ]
    ((heads, cells, *_),) = tables
    asked = ("model", "median ms", "preparation s", "resection known after s", "memory GiB", "reliable loads")
    stated = dict(zip(heads, cells, strict=True))
    assert [stated[head] for head in asked] == ["svr", "1.5", "300", "70", "0.25", "3 of 4"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--loads", "0"], "--loads 0"),
        (["--device", "abacus"], "abacus"),
        (["--data", "a/x.h5", "b/x.h5"], "the same name"),
        (["--data", "a.h5", "--anatomy", "b.vtu"], "--anatomy"),
        (["--data", "a.h5"], "no such file"),
    ],
)
def test_report_command_rejects_bad_input(words, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["report", *words]) == 2
    assert reason in capsys.readouterr().err


def test_report_command_without_data_simulates_its_own(tmp_path, monkeypatch, capsys):
    """Neo-Hookean, smoothed, on two devices; log text is not mixed with the JSON line."""
    box = make_box((6, 6, 4), tumour=9e-3, depth=14e-3, opening=20e-3)
    monkeypatch.setattr("scenes.report.rows.measure_rows", lambda study, specs: iter([]))
    write_anatomy(tmp_path / "box.vtu", box)
    words = ["report", "--quick", "--anatomy", str(tmp_path / "box.vtu"), "--out", str(tmp_path), "--device"]
    assert main([*words, "cpu,cpu", "--loads", "1", "--json"]) == 0
    (section,) = json.loads(capsys.readouterr().out)["sections"]
    assert f"{QUICK_COUNTS[0] - 1} palpation loads" in section["about"][0]  # one inverts tetrahedra
    data = read_dataset(tmp_path / "palpation.h5")
    assert data.estimate_seconds("load", QUICK_COUNTS[0]) > 0.0
    assert data.provenance["element"] == "smoothed" and "neo-hookean" in data.provenance["tissue"]
