"""`sulcus report`: figures recomputed independently, and a page without external resources."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from studies import SPECS, TISSUE

from ar.screen import read_png
from scenes.cli import main
from scenes.report.finite_elements import HALVED_MESH, OWN_MESH, FemVariant, describe_difference
from scenes.report.page import Section, write_report
from scenes.report.row import DIFFERENCE, ERROR, TOLERANCE_ALONE, ReportRow
from sim.accuracy import REFERENCE, TRAIN
from sim.effects import build_push_effects
from sim.families.registry import build_family
from sim.fem import Fem
from surrogate.data.dataset import read_dataset
from surrogate.training.train import train


@pytest.fixture(scope="module")
def page(study, study_rows):
    write_report(study.folder, "this machine", [Section("data", ("About <this>.",), study_rows)])
    return study.folder


def figures_by_hand(distance, truth):
    share = 100.0 * distance / np.linalg.norm(truth, axis=2).mean(axis=1)[:, None]
    return [f(v) for v in (1e3 * distance, share) for f in (np.mean, lambda x: np.percentile(x, 95), np.max)]


def test_report_figures_match_independent_recomputation(study, page, study_box):
    """Quadratic reference, FEM and a learner's error on its training loads, each from its own source."""
    stored = json.loads((page / "report.json").read_text())["sections"][0]["rows"]
    with open(page / "data.csv") as file:
        lines = list(csv.DictReader(file))
    assert [line["name"] for line in lines] == [row["name"] for row in stored]
    assert [row["name"] for row in stored] == [spec.name for spec in SPECS]
    effects = build_push_effects(study_box, TISSUE)
    truth = (
        Fem(study_box, effects, REFERENCE, "cpu", element="p2")
        .deform(study.test_loads)
        .restrict(study_box.tumour_nodes)
        .displacement
    )
    answer = (
        Fem(study_box, effects, TRAIN, "cpu", element="p1")
        .deform(study.test_loads)
        .restrict(study_box.tumour_nodes)
        .displacement
    )
    wanted = figures_by_hand(np.linalg.norm(answer - truth, axis=2), truth)
    names = ("mean", "p95", "largest")  # of so few loads no percentile of a thousand is reported
    for kind, values in (("mm", wanted[:3]), ("percent", wanted[3:])):
        assert stored[0]["reference"][kind]["p999"] is None and lines[0][f"reference.{kind}.p999"] == ""
        assert np.allclose([stored[0]["reference"][kind][name] for name in names], values, rtol=2e-3)
        assert np.allclose([float(lines[0][f"reference.{kind}.{name}"]) for name in names], values, rtol=2e-3)
    data = read_dataset(study.data)
    test = study.disc_split.test_mask
    model = train(data, ["linear"], split=study.disc_split).models["linear"]
    truth = data.read_displacement(study_box.tumour_nodes)[test]
    guess = model.deform(data.loads.select(np.flatnonzero(test)), at=study_box.tumour_nodes).displacement
    wanted = figures_by_hand(np.linalg.norm(guess - truth, axis=2), truth)
    held = stored[2]["own_fem"]["discs"]
    assert np.allclose([held[kind][each] for kind in ("mm", "percent") for each in names], wanted, rtol=1e-5)
    worst = 1e3 * np.linalg.norm(guess - truth, axis=2).max(axis=1)
    worst = [worst.mean(), np.percentile(worst, 95.0), worst.max()]
    assert np.allclose([held["worst"][each] for each in names], worst, rtol=1e-5)
    assert held["loads"] == test.sum() and held["values"] == test.sum() * len(study_box.tumour_nodes)
    assert stored[2]["loads"] == study.disc_split.training_mask.sum()
    assert stored[2]["units"] == 3 * study_box.craniotomy.sum()


def test_report_page_loads_no_external_resources(page, study_rows):
    text = (page / "index.html").read_text()
    assert not re.search(r"https?:|<script|<link|@import|src=|url\((?!#)", text)
    for words in ("Reliable loads", "a model difference", "About &lt;this&gt;."):
        assert words in text
    assert text.count("<svg") == 6 and text.index("<svg") < text.index("<table"), "error against time comes first"
    assert "<title>condensed, other mechanics: mean" in text, "a row shows where the pointer rests"
    assert [read_png(path).std() > 5.0 for path in page.glob("data-*.png")] == [True] * 6


def test_family_rows_have_error_and_outcome_of_each_load(study, study_rows, study_box):
    """Table against linear FEM of the same tissue to a small tolerance."""
    fem, _, learner, condensed, plate = study_rows
    nodes = np.union1d(study.patch.nodes, study_box.tumour_nodes)
    effects = build_push_effects(study_box, TISSUE)
    truth = Fem(study_box, effects, REFERENCE, "cpu", element="p2").deform(study.test_loads, at=nodes).displacement
    found = build_family("condensed", study_box, effects, "cpu").deform(study.test_loads, at=nodes).displacement
    distance = 1e3 * np.linalg.norm(found - truth, axis=2)
    for name, part in (("load_mm", study_box.tumour_nodes), ("cortex_mm", study.patch.nodes)):
        wanted = distance[:, np.isin(nodes, part)].mean(axis=1)
        assert np.allclose(getattr(condensed, name), wanted, rtol=1e-3)
    assert condensed.reference.mm.mean == pytest.approx(np.mean(condensed.load_mm))
    assert fem.reference.mm.mean < plate.reference.mm.mean
    assert sum(condensed.outcomes.values()) == sum(fem.outcomes.values()) == len(study.test_loads)
    assert set(plate.outcomes) <= {"GUESSED", "INVERTED", "OVERSTRAINED"}
    assert learner.cortex_mm == () and len(learner.load_mm) == len(study.test_loads)
    assert condensed.preparation == condensed.set_up > 0.0 and condensed.adapt > 0.0
    assert condensed.central_ms[0] <= condensed.median <= condensed.central_ms[1]


@pytest.mark.parametrize("fine", [False, True])
def test_row_with_reference_elements_differs_by_tolerance_only(study, fine):
    here = replace(study, thorough=fine)
    said = {
        (element, mesh): describe_difference(here, FemVariant("it", element=element, mesh=mesh))
        for element in ("p1", "p2")
        for mesh in (OWN_MESH, HALVED_MESH)
    }
    alone = ("p2", HALVED_MESH if fine else OWN_MESH)
    assert said.pop(alone) == TOLERANCE_ALONE and set(said.values()) == {ERROR}
    assert describe_difference(here, FemVariant("it", "linear", *alone)) == DIFFERENCE


def test_report_command_writes_page_and_lists_missing_row(study, study_rows, monkeypatch, capsys):
    """All loads are solved before; the rows are those of the fixture."""
    words = ["report", "--quick", "--loads", str(study.loads), "--data", str(study.data), "--out", str(study.folder)]
    words += ["--device", "cpu"]
    monkeypatch.setattr("scenes.report.rows.measure_rows", lambda study, specs: iter(study_rows))
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in said["sections"][0]["rows"]] == [row.name for row in study_rows]
    assert "quadratic tetrahedra (p2) on the same mesh" in (study.folder / "index.html").read_text()
    monkeypatch.setattr(
        "scenes.report.rows.measure_rows", lambda study, specs: iter([ReportRow("odd", "f", state="no memory")])
    )
    assert main(words) == 1
    assert "no memory" in capsys.readouterr().out

    def stopped(study, specs):
        raise KeyboardInterrupt

    monkeypatch.setattr("scenes.report.rows.measure_rows", stopped)
    assert main(words) == 130
    assert "run the same command again to resume" in capsys.readouterr().err
