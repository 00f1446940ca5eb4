"""Rows of a report: measured once, or with a reason."""

import os
import shutil
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from distributed import Scheduler, SpecCluster
from poison import poisoned
from studies import SPECS, TISSUE, read_back, solved

from scenes.analysis.measurement import measure_peak_memory
from scenes.report.finite_elements import OWN_MESH, FamilySpec, FemVariant
from scenes.report.learner import LearnerSpec, compute_coverage_beyond, list_counts, measure_learner
from scenes.report.reference import get_reference, get_solutions_beyond
from scenes.report.rows import (
    list_all_combinations,
    list_learner_specs,
    list_one_factor_variants,
    measure_on_workers,
    measure_row,
    measure_rows,
)
from scenes.report.study import measure_series_seconds, tabulate_series
from sim.accuracy import TRAIN
from sim.errors import InputError
from sim.loads import Pushed
from sim.runtime.threads import limit_to_one_thread
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import compute_tool_features, fit_basis, split_forces
from surrogate.data.splits import hold_out_sectors
from surrogate.training.expansion import COARSE_BASIS, SERIES_MODELS
from surrogate.training.learners import SVR_CANDIDATES, TunedRegressor
from surrogate.training.train import train


def test_learner_error_is_computed_on_held_out_loads(study, study_box, tmp_path, monkeypatch):
    """Trained here on the training rows; the report's file has wrong solutions of the held-out loads."""
    study = solved(replace(study, thorough=True))
    training, pushed, nodes = study.disc_split.training_mask, study.pushed, study_box.tumour_nodes
    truth = study.dataset.read_displacement(nodes)[study.dataset.good]
    path, wild = poisoned(
        study.data, tmp_path / "data.h5", np.flatnonzero(study.dataset.good)[study.disc_split.test_mask]
    )
    monkeypatch.setattr("scenes.report.learner.list_counts", lambda most: [])
    monkeypatch.setattr("scenes.report.learner.compute_coverage_beyond", lambda *known: {})
    with limit_to_one_thread():
        row = measure_learner(replace(study, data=path), LearnerSpec("svr"))
    lesson = Pushed(pushed.point[training], pushed.force[training], pushed.footprint[training])
    size, (every, direction) = split_forces(lesson)[0], split_forces(pushed)
    basis = fit_basis(nodes, truth[training] / size[:, None, None], *COARSE_BASIS)
    machine = TunedRegressor(SVR_CANDIDATES).fit(
        compute_tool_features(study.patch, lesson), basis.encode(truth[training] / size[:, None, None])
    )
    within = replace(pushed, force=np.clip(every, size.min(), size.max())[:, None] * direction)
    guess = every[:, None, None] * basis.decode(machine.predict(compute_tool_features(study.patch, within)))
    played = [np.flatnonzero((pushed.point == point).all(axis=1))[0] for point in study.test_loads.get(Pushed).point]
    exact = get_reference(study).displacement[:, np.isin(study.read_nodes, nodes)]
    mean = 1e3 * np.linalg.norm(guess[played] - exact, axis=2).mean(axis=1)
    np.testing.assert_allclose(row.load_mm, mean, rtol=1e-3)
    wanted = 1e3 * np.linalg.norm(guess[study.disc_split.test_mask] - wild[nodes], axis=2)
    mm = row.own_fem["discs"].mm
    assert (mm.mean, mm.largest) == pytest.approx((wanted.mean(), wanted.max()), rel=1e-4)
    assert row.loads == training.sum()
    # Of loads that point into the sectors, by a model of those that do not.
    data, sectors = read_dataset(path), hold_out_sectors(pushed, study.patch)
    asked = data.loads.select(np.flatnonzero(data.good)[sectors.test_mask])
    guess = train(data, ["svr"], split=sectors).models["svr"].deform(asked, at=nodes).displacement
    wanted = 1e3 * np.linalg.norm(guess - data.read_displacement(nodes)[data.good][sectors.test_mask], axis=2)
    mm = row.own_fem["sectors"].mm
    assert row.curve[-1] == (row.loads, row.own_fem["discs"])
    assert (mm.mean, mm.largest) == pytest.approx((wanted.mean(), wanted.max()), rel=1e-4)


def test_played_loads_lie_in_the_held_out_discs(study):
    every = replace(study, loads=10_000).test_loads.get(Pushed)
    some, split = study.test_loads.get(Pushed), study.disc_split
    assert len(every.point) == split.test_mask.sum() and len(some.point) == 2
    for pushed in (every, some):
        into = np.linalg.norm(pushed.point[:, None] - split.centres, axis=2).min(axis=1)
        assert into.max() <= split.radius
        assert not np.isin(pushed.point[:, 0], study.pushed.point[split.training_mask, 0]).any()
    training = np.linalg.norm(study.pushed.point[split.training_mask][:, None] - split.centres, axis=2).min(axis=1)
    assert training.min() > split.radius
    force, size = (np.linalg.norm(each.force, axis=1) for each in (some, every))
    assert list(force) == [size.min(), size.max()]


def test_rows_state_error_type_and_coverage(study, study_rows):
    fem, law, learner = study_rows[:3]
    assert (fem.against, law.against, learner.against) == ("error", "model difference", "error")
    assert law.reference.mm.mean > fem.reference.mm.mean > 0.0 and not fem.own_fem
    assert set(learner.own_fem) == {"discs", "beyond"} and learner.flagged["beyond"] == 1.0
    beyond = get_solutions_beyond(study)
    outside, answers = study.loads_beyond.select(np.flatnonzero(beyond.good)), beyond.displacement[beyond.good]
    covered = compute_coverage_beyond(study, LearnerSpec("linear"), outside, answers)
    assert set(covered) == {"discs", "beyond"} and max(covered.values()) <= 1.0 and not learner.covered
    assert learner.own_fem["beyond"].percent.mean > learner.own_fem["discs"].percent.mean
    assert (fem.timed, fem.p99, learner.timed) == (2, None, 30) and fem.median > learner.median > 0.0
    assert learner.adapt is None and fem.adapt > 0.0 and learner.curve == ()
    assert read_back(learner) == learner
    assert 0.05 < measure_peak_memory() < 50.0


def test_series_is_tabulated_once_for_all_rows(study, monkeypatch):
    """A row made from the stored table needs no FEM, and keeps the table's seconds."""
    reported = []
    tabulate_series(study, lambda done, total: reported.append((done, total)))
    assert reported and reported[-1][0] == reported[-1][1]
    monkeypatch.setattr("surrogate.training.expansion.Expansion.build_fem", None)
    tabulate_series(study, lambda done, total: reported.append(None))
    assert None not in reported
    row = measure_row(replace(study), LearnerSpec("series"))
    assert row.state == "measured" and row.solving > 0.1 * measure_series_seconds(study, "series") > 0.0
    assert row.series > 19 and row.inside > 0  # unit responses
    assert measure_series_seconds(study, "linear") == 0.0
    assert row.own_fem["discs"].mm.mean < 0.5 * measure_row(study, SPECS[2]).own_fem["discs"].mm.mean
    assert {spec.name for spec in list_learner_specs()} > set(SERIES_MODELS)


def test_only_missing_rows_are_measured_again(study, study_rows, tmp_path):
    """Stopped in the second row and resumed; then with other inputs; then with a truncated file."""
    here = replace(study, folder=tmp_path)
    asked = []

    def run(study, spec):
        asked.append(spec.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return next(row for row in study_rows if row.name == spec.name)

    with pytest.raises(KeyboardInterrupt):
        list(measure_rows(here, SPECS, run))
    assert tuple(measure_rows(here, SPECS, run)) == study_rows
    assert asked == ["FEM", "linear law", "linear law", *(spec.name for spec in SPECS[2:])]
    assert tuple(measure_rows(here, SPECS, run)) == study_rows and len(asked) == 6
    list(measure_rows(replace(here, timed=31), SPECS[:1], run))
    assert asked[6:] == ["FEM"]
    kept = tmp_path / "rows" / "data-linear.json"
    kept.write_text(kept.read_text()[:-9])
    list(measure_rows(here, SPECS, run))
    assert asked[7:] == ["FEM", "linear"], "the first file held other inputs, the last was not whole"


def test_report_plans_list_unique_variants(study):
    quick, thorough = (list_one_factor_variants(replace(study, thorough=thorough)) for thorough in (False, True))
    names = [spec.name for spec in thorough]
    assert names[0] == "FEM" and len(set(names)) == len(names) == 12 and "FEM halved edges" in names
    assert thorough[0].accuracy == TRAIN and thorough[-1].law != TISSUE.law
    assert set(quick) < set(thorough) and len(quick) == 7 and all(spec.mesh == OWN_MESH for spec in quick)
    product = list_all_combinations(study)
    assert len({spec.name for spec in product}) == len(product) == 4 * 3 * 2 * (3 + 5)
    assert list_counts(300) == [64, 128, 256] and list_counts(64) == []


def test_row_of_unknown_element_states_the_reason(study):
    row = measure_row(study, FemVariant("odd", element="cube"))
    assert "no element is called 'cube'" in row.state and row.reference is None and row.family == "finite elements"


def test_rows_are_measured_by_workers_of_a_scheduler(study, tmp_path):
    """One worker, in another process; its rows are stored, and read instead of measured by the next call."""
    here = replace(study, folder=tmp_path)
    shutil.copytree(study.folder / "answers", tmp_path / "answers")
    specs = (FamilySpec("thin-plate"), LearnerSpec("linear"))
    command = [sys.executable, "-m", "dask", "worker", "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with ExitStack() as closing:
        own = closing.enter_context(SpecCluster({}, {"cls": Scheduler, "options": {"host": "127.0.0.1", "port": 0}}))
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        address = own.scheduler_address
        worker = subprocess.Popen([*command, address], env=environment, cwd=tmp_path, **quiet)
        closing.enter_context(worker)
        closing.callback(worker.terminate)
        rows = list(measure_on_workers(here, specs, address))
        stored = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "rows").iterdir()}
        again = list(measure_on_workers(here, specs, address))
        with pytest.raises(InputError, match="a worker does not see"):
            list(measure_on_workers(replace(here, data=tmp_path / "elsewhere.h5"), specs, address))
    assert [row.name for row in rows] == ["thin-plate", "linear"] and all(row.state == "measured" for row in rows)
    assert again == rows and len(stored) == 2
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "rows").iterdir()} == stored
