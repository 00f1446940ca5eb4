"""`sulcus report`: its numbers by hand, runs that go on where they stopped, the front, a page that needs nothing."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from poison import poisoned
from studies import TISSUE, nothing, read_back, study_of

from ar.screen import read_png
from scenes.analysis.measurement import peak_memory
from scenes.cli import main
from scenes.report.adaptation import debulked, debulked_study, simulate_debulked, simulating_seconds
from scenes.report.finite_elements import HALVED, OWN, Elements, against
from scenes.report.learner import Learner, counts, measure_learner
from scenes.report.page import Section, write_report
from scenes.report.reference import Truth, beyond_of, reference_of, solve_reference
from scenes.report.row import DIFFERENCE, ERROR, TOLERANCE_ALONE, Row, against_reference
from scenes.report.rows import every, learners, measured, rows, star
from scenes.report.study import series_seconds, tabulate_series
from sim.accuracy import REFERENCE, TRAIN
from sim.effects import pushed_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Pushed
from sim.runtime.threads import one_thread
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import directions, reduce, tool_features
from surrogate.data.splits import leave_sectors_out
from surrogate.model.training_range import envelope_of
from surrogate.training.expansion import COARSE, EXPANDED
from surrogate.training.learners import SVR, Tuned
from surrogate.training.train import train

SPECS = (Elements("FEM"), Elements("linear law", law="linear"), Learner("linear"))


@pytest.fixture(scope="module")
def box():
    return make_box((6, 6, 4), tumour=9e-3, depth=14e-3, opening=20e-3)


@pytest.fixture(scope="module")
def study(tmp_path_factory, box):
    return study_of(tmp_path_factory.mktemp("report"), box, 280)


@pytest.fixture(scope="module")
def found(study):
    return tuple(rows(study, SPECS, measured))


@pytest.fixture(scope="module")
def page(study, found):
    write_report(study.folder, "this machine", [Section("data", ("About <this>.",), found)])
    return study.folder


def figures_by_hand(distance, truth):
    share = 100.0 * distance / np.linalg.norm(truth, axis=2).mean(axis=1)[:, None]
    return [f(v) for v in (1e3 * distance, share) for f in (np.mean, lambda x: np.percentile(x, 95), np.max)]


def test_numbers_are_those_recomputed_by_hand(study, page, box):
    """Quadratic reference, finite elements, and a learner against those it was trained on, each from its own source."""
    stored = json.loads((page / "report.json").read_text())["sections"][0]["rows"]
    with open(page / "data.csv") as file:
        lines = list(csv.DictReader(file))
    assert [line["name"] for line in lines] == [row["name"] for row in stored]
    assert [row["name"] for row in stored] == [spec.name for spec in SPECS]
    effects = pushed_effects(box, TISSUE)
    truth = Fem(box, effects, REFERENCE, "cpu", element="p2").deform(study.played).at(box.tumour_nodes).displacement
    answer = Fem(box, effects, TRAIN, "cpu", element="p1").deform(study.played).at(box.tumour_nodes).displacement
    wanted = figures_by_hand(np.linalg.norm(answer - truth, axis=2), truth)
    names = ("mean", "p95", "largest")  # of so few loads no percentile of a thousand is reported
    for kind, values in (("mm", wanted[:3]), ("percent", wanted[3:])):
        assert stored[0]["reference"][kind]["p999"] is None and lines[0][f"reference.{kind}.p999"] == ""
        assert np.allclose([stored[0]["reference"][kind][name] for name in names], values, rtol=2e-3)
        assert np.allclose([float(lines[0][f"reference.{kind}.{name}"]) for name in names], values, rtol=2e-3)
    data = read_dataset(study.data)
    for name, split in (("discs", study.discs), ("sectors", leave_sectors_out(study.pushed, study.patch))):
        test = split.test
        model = train(data, ["linear"], split=split).models["linear"]
        truth = data.displacement(box.tumour_nodes)[test]
        guess = model.deform(data.loads.rows(np.flatnonzero(test)), at=box.tumour_nodes).displacement
        wanted = figures_by_hand(np.linalg.norm(guess - truth, axis=2), truth)
        held = stored[2]["own_fem"][name]
        assert np.allclose([held[kind][each] for kind in ("mm", "percent") for each in names], wanted, rtol=1e-5)
        miss = 1e3 * np.linalg.norm(guess - truth, axis=2).max(axis=1)
        worst = [miss.mean(), np.percentile(miss, 95.0), miss.max()]
        assert np.allclose([held["worst"][each] for each in names], worst, rtol=1e-5)
        assert held["loads"] == test.sum() and held["values"] == test.sum() * len(box.tumour_nodes)
    assert stored[2]["loads"] == study.discs.train.sum() and stored[2]["units"] == 3 * box.craniotomy.sum()


def test_a_learner_is_held_to_loads_that_it_was_not_trained_on(study, box, tmp_path, monkeypatch):
    """Fitted here to the training rows; in the file that the report reads, answers to the discs' loads are wild."""
    training, pushed, nodes = study.discs.train, study.pushed, box.tumour_nodes
    truth = study.dataset.displacement(nodes)[study.dataset.good]
    path, wild = poisoned(study.data, tmp_path / "data.h5", np.flatnonzero(study.dataset.good)[study.discs.test])
    monkeypatch.setattr("scenes.report.learner.counts", lambda most: [])
    monkeypatch.setattr("scenes.report.learner.coverage_of", lambda *known: {})
    with one_thread():
        row, field = measure_learner(replace(study, data=path), Learner("svr"))
    lesson = Pushed(pushed.point[training], pushed.force[training], pushed.footprint[training])
    size, (every, direction) = directions(lesson)[0], directions(pushed)
    basis = reduce(nodes, truth[training] / size[:, None, None], *COARSE)
    machine = Tuned(SVR).fit(tool_features(study.patch, lesson), basis.encode(truth[training] / size[:, None, None]))
    within = replace(pushed, force=np.clip(every, size.min(), size.max())[:, None] * direction)
    guess = every[:, None, None] * basis.decode(machine.predict(tool_features(study.patch, within)))
    played = [np.flatnonzero((pushed.point == point).all(axis=1))[0] for point in study.played.of(Pushed).point]
    np.testing.assert_allclose(field, guess[played], rtol=1e-3, atol=1e-9)
    wanted = 1e3 * np.linalg.norm(guess[study.discs.test] - wild[nodes], axis=2)
    mm = row.own_fem["discs"].mm
    assert (mm.mean, mm.largest) == pytest.approx((wanted.mean(), wanted.max()), rel=1e-4)
    assert row.loads == training.sum()
    # Of loads that point into the sectors, by a model of those that do not.
    data, sectors = read_dataset(path), leave_sectors_out(pushed, study.patch)
    asked = data.loads.rows(np.flatnonzero(data.good)[sectors.test])
    guess = train(data, ["svr"], split=sectors).models["svr"].deform(asked, at=nodes).displacement
    wanted = 1e3 * np.linalg.norm(guess - data.displacement(nodes)[data.good][sectors.test], axis=2)
    mm = row.own_fem["sectors"].mm
    assert (mm.mean, mm.largest) == pytest.approx((wanted.mean(), wanted.max()), rel=1e-4)


def test_what_is_played_lies_in_the_discs_alone(study):
    every = replace(study, loads=10_000).played.of(Pushed)
    some, split = study.played.of(Pushed), study.discs
    assert len(every.point) == split.test.sum() and len(some.point) == 2
    for pushed in (every, some):
        into = np.linalg.norm(pushed.point[:, None] - split.centres, axis=2).min(axis=1)
        assert into.max() <= split.radius
        assert not np.isin(pushed.point[:, 0], study.pushed.point[split.train, 0]).any()
    training = np.linalg.norm(study.pushed.point[split.train][:, None] - split.centres, axis=2).min(axis=1)
    assert training.min() > split.radius
    force, size = (np.linalg.norm(each.force, axis=1) for each in (some, every))
    assert list(force) == [size.min(), size.max()]


def test_rows_say_what_they_are(found):
    fem, law, learner = found
    assert (fem.against, law.against, learner.against) == ("error", "model difference", "error")
    assert law.reference.mm.mean > fem.reference.mm.mean > 0.0 and not fem.own_fem
    assert set(learner.own_fem) == {"discs", "sectors", "beyond"} and learner.flagged["beyond"] == 1.0
    assert set(learner.covered) == {"discs", "beyond"} and max(learner.covered.values()) <= 1.0
    assert learner.own_fem["beyond"].percent.mean > learner.own_fem["discs"].percent.mean
    assert (fem.timed, fem.p99, learner.timed) == (2, None, 30) and fem.median > learner.median > 0.0
    assert learner.adapt is None and fem.adapt > 0.0 and learner.curve[-1] == (learner.loads, learner.own_fem["discs"])
    assert read_back(learner) == learner
    assert 0.05 < peak_memory() < 50.0


def test_a_series_is_tabulated_once_for_all_its_rows(study, tmp_path, monkeypatch):
    """Made of what is kept, a row has no finite elements to ask; the table's seconds are its own all the same."""
    reported = []
    tabulate_series(study, lambda done, total: reported.append((done, total)))
    assert reported and reported[-1][0] == reported[-1][1]
    monkeypatch.setattr("surrogate.training.expansion.Expansion.fem", None)
    tabulate_series(study, lambda done, total: reported.append(None))
    assert None not in reported
    row = measured(replace(study), Learner("series"), tmp_path / "series.png")
    assert row.state == "measured" and row.solving > 0.1 * series_seconds(study, "series") > 0.0
    assert row.series > 19 and row.inside > 0  # unit responses
    assert series_seconds(study, "linear") == 0.0
    assert row.own_fem["discs"].mm.mean < 0.5 * measured(study, SPECS[2], tmp_path / "l.png").own_fem["discs"].mm.mean
    assert {spec.name for spec in learners()} > set(EXPANDED)


def test_only_loads_that_both_converged_for_are_compared(study, box, monkeypatch):
    truth = Truth(np.full((2, len(study.drawn), 3), 1e-3), np.array([True, False]), np.ones(2))
    monkeypatch.setattr("scenes.report.row.reference_of", lambda study: truth)
    answer = np.full((2, len(box.tumour_nodes), 3), [[[1e-3, 1e-3, 3e-3]], [[np.nan] * 3]])
    for good, loads in (([True, True], 1), ([True, False], 1)):
        figures = against_reference(study, answer, np.array(good), box.tumour_nodes)
        assert figures.loads == loads and figures.mm.mean == pytest.approx(2.0) == figures.mm.largest
    assert against_reference(study, answer, np.array([False, True]), box.tumour_nodes) is None


def test_only_what_lacks_is_measured_again(study, found, tmp_path):
    """Stopped in the second row, begun again; then with other inputs; then with a file that is not whole."""
    here = replace(study, folder=tmp_path)
    asked = []

    def run(study, spec, picture):
        asked.append(spec.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return next(row for row in found if row.name == spec.name)

    with pytest.raises(KeyboardInterrupt):
        list(rows(here, SPECS, run))
    assert tuple(rows(here, SPECS, run)) == found
    assert asked == ["FEM", "linear law", "linear law", "linear"]
    assert tuple(rows(here, SPECS, run)) == found and len(asked) == 4
    list(rows(replace(here, timed=31), SPECS[:1], run))
    assert asked[4:] == ["FEM"]
    kept = tmp_path / "rows" / "data-linear.json"
    stored = json.loads(kept.read_text())
    former = {"own_fem": "teacher", "loads": "taught"}
    row = {former.get(name, name): value for name, value in stored["row"].items()}
    kept.write_text(json.dumps({**stored, "row": row}))
    assert tuple(rows(here, SPECS[2:3], run)) == found[2:3] and "teacher" in row and len(asked) == 5
    kept.write_text(kept.read_text()[:-9])
    list(rows(here, SPECS, run))
    assert asked[5:] == ["FEM", "linear"], (
        "the first file held other inputs, the last was not whole; names from before are read"
    )


def test_a_reference_goes_on_load_by_load(study, monkeypatch):
    deform = Fem.deform
    before = reference_of(study)
    lost = sorted((study.folder / "answers").glob("reference-*"))[1]
    lost.unlink()
    solved = []
    monkeypatch.setattr(Fem, "deform", lambda self, loads, *rest: solved.append(len(loads)) or deform(self, loads))
    reported = []
    solve_reference(study, reported.append)
    assert solved == [1] and reported == [1, 1]
    assert np.allclose(reference_of(study).displacement, before.displacement, atol=1e-12) and before.good.all()


def test_a_damaged_answer_is_named(study):
    """So is a damaged table of the series: a stopped run goes on from both."""
    reference_of(study)
    kept = study.folder / "answers"
    answer, table = min(kept.glob("reference-*")), kept / f"series-{study.digest}.npz"
    for path, ask in ((answer, lambda: reference_of(study)), (table, lambda: replace(study).expansion.tabulated)):
        path.write_bytes(b"PK" * 100)
        with pytest.raises(InputError, match=f"{path.name}.*Delete it: it is made anew"):
            ask()
        path.unlink()


def test_a_finer_reference_is_read_at_the_same_points(study, tmp_path):
    """On a coarse box halving every edge changes the motion by some percent, not by half."""
    one, fine = (replace(study, folder=tmp_path, loads=1, fine=fine) for fine in (False, True))
    for each in (one, fine):
        solve_reference(each, nothing, TRAIN)
    coarse, finer = reference_of(one).displacement, reference_of(fine).displacement
    off = np.linalg.norm(coarse - finer, axis=2).mean() / np.linalg.norm(finer, axis=2).mean()
    assert 1e-3 < off < 0.3


def test_the_page_needs_nothing_but_itself(page, found):
    text = (page / "index.html").read_text()
    assert not re.search(r"https?:|<script|<link|@import|url\(", text)
    sources = re.findall(r'src="([^"]{0,30})', text)
    assert len(sources) == 3 + 3 and all(source.startswith("data:image/png;base64,") for source in sources)
    for words in ("not measured", "model difference", "About &lt;this&gt;."):
        assert words in text
    assert text.index("<img") < text.index("<table"), "error against time comes first"
    for row in found[:3]:
        assert read_png(page / "pictures" / row.picture).std() > 5.0


def test_what_lies_beyond_is_outside_the_envelope(study):
    training = study.converged.rows(np.flatnonzero(study.discs.train)).of(Pushed)
    outside = study.outside.of(Pushed)
    assert not envelope_of(study.patch, training).holds(study.patch, outside).any()
    size = np.linalg.norm(outside.force, axis=1)
    assert (size[::3] > 1.19 * np.linalg.norm(training.force, axis=1).max()).all()
    assert (study.patch.rim_distance(outside.point[2::3]) < outside.footprint[2::3]).all()
    assert beyond_of(study).displacement.shape == (study.beyond, len(study.anatomy.tumour_nodes), 3)


def test_plans(study):
    names = [spec.name for spec in star(study)]
    assert names[0] == "FEM" and len(set(names)) == len(names) == 12 and "FEM halved edges" in names
    assert star(study)[0].accuracy == TRAIN and star(study)[-1].law != TISSUE.law
    assert not any(spec.mesh != OWN for spec in star(study, remesh=False)) and len(star(study, remesh=False)) == 11
    product = every(study)
    assert len({spec.name for spec in product}) == len(product) == 4 * 3 * 2 * (3 + 5)
    assert counts(300) == [64, 128, 256] and counts(64) == []


@pytest.mark.parametrize("fine", [False, True])
def test_what_has_the_reference_s_own_elements_is_off_by_its_tolerance_alone(study, fine):
    here = replace(study, fine=fine)
    said = {
        (element, mesh): against(here, Elements("it", element=element, mesh=mesh))
        for element in ("p1", "p2")
        for mesh in (OWN, HALVED)
    }
    alone = ("p2", HALVED if fine else OWN)
    assert said.pop(alone) == TOLERANCE_ALONE and set(said.values()) == {ERROR}
    assert against(here, Elements("it", "linear", *alone)) == DIFFERENCE


def test_what_cannot_be_had_is_a_row_that_says_why(study, tmp_path):
    row = measured(study, Elements("odd", element="cube"), tmp_path / "odd.png")
    assert "no element is called 'cube'" in row.state and row.reference is None and row.family == "finite elements"


def test_the_command_writes_the_page_and_says_when_a_row_is_lacking(study, found, monkeypatch, capsys):
    """Everything is solved already; the rows are those found."""
    words = ["report", "--quick", "--loads", str(study.loads), "--data", str(study.data), "--out", str(study.folder)]
    words += ["--device", "cpu"]
    monkeypatch.setattr("scenes.report.rows.rows", lambda study, specs: iter(found))
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in said["sections"][0]["rows"]] == [row.name for row in found]
    assert "quadratic tetrahedra (p2) on the same mesh" in (study.folder / "index.html").read_text()
    monkeypatch.setattr("scenes.report.rows.rows", lambda study, specs: iter([Row("odd", "f", state="no memory")]))
    assert main(words) == 1
    assert "no memory" in capsys.readouterr().out

    def stopped(study, specs):
        raise KeyboardInterrupt

    monkeypatch.setattr("scenes.report.rows.rows", stopped)
    assert main(words) == 130
    assert "the same command goes on" in capsys.readouterr().err


class TestAdapting:
    def test_a_debulked_body_lacks_a_fifth_of_its_tumour_and_nothing_else(self, box):
        after = debulked(box)
        volume = [body.mesh.volumes[body.mesh.region == 2].sum() for body in (after, box)]
        element = box.mesh.volumes[box.mesh.region == 2].max()
        assert 0.8 * volume[1] <= volume[0] <= 0.8 * volume[1] + element
        assert after.mesh.volumes.sum() == pytest.approx(box.mesh.volumes.sum() - volume[1] + volume[0])
        assert len(np.unique(after.mesh.tets)) == len(after.mesh.nodes)
        for name in ("held", "slide_normal"):
            known = {
                tuple(place): tuple(value) for place, value in zip(box.mesh.nodes, getattr(box, name), strict=True)
            }
            ours = zip(after.mesh.nodes, getattr(after, name), strict=True)
            assert all(known[tuple(place)] == tuple(value) for place, value in ours)
        np.testing.assert_array_equal(
            after.mesh.nodes[after.craniotomy], box.mesh.nodes[box.craniotomy]
        )  # the cavity is inside

    def test_elements_are_set_up_and_learners_trained_anew(self, study, found):
        reported = []
        simulate_debulked(study, reported.append)
        simulate_debulked(study, reported.append)
        rows_in_all = len(study.dataset.loads) + len(study.dataset.unit_good)
        assert sum(reported) == 2 * rows_in_all
        row = measured(study, Learner("linear"), study.folder / "adapted.png")
        after = debulked_study(study)
        model = train(after.dataset, ["linear"], split=after.discs).models["linear"]
        test = np.flatnonzero(after.discs.test)
        guess = model.deform(after.converged.rows(test), at=after.anatomy.tumour_nodes).displacement
        wanted = 1e3 * np.linalg.norm(guess - after.answers[test], axis=2).mean()
        assert row.adapted.mm.mean == pytest.approx(wanted, rel=1e-6)
        assert row.adapt > simulating_seconds(study) > 0.0
        assert found[0].adapt > 0.0 and found[0].adapted is None
        assert any("L-BFGS" in line for line in found[0].plan) and not row.plan
        assert found[2].adapt is None  # no data of the debulked body yet

    def test_a_run_that_was_stopped_has_no_time(self, study, monkeypatch):
        path = debulked_study(study).data
        path.unlink(missing_ok=True)
        path.with_suffix(".json").unlink(missing_ok=True)

        def stopped(done):
            if done:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            simulate_debulked(study, stopped)
        simulate_debulked(study, nothing)
        assert path.exists() and simulating_seconds(study) is None
