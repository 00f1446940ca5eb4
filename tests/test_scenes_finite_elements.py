"""`sulcus report`: rows measured in parallel, and interruption."""

import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest
from conftest import make_box
from studies import study_of

from scenes.report.finite_elements import FemVariant
from scenes.report.learner import LearnerSpec
from scenes.report.row import ReportRow
from scenes.report.rows import measure_in_process, measure_rows

SPECS = (*(FemVariant(f"fem {k}") for k in range(4)), *(LearnerSpec(f"learner {k}") for k in range(9)))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return study_of(tmp_path_factory.mktemp("report"), make_box(tumour=9e-3, depth=12e-3, opening=20e-3), 60)


class Rows:
    """Rows that take as long as others that may be under way with them; "fail" is the name of one that is stopped."""

    def __init__(self, fail=""):
        self.fail, self.begun, self.now, self.most, self.lock = fail, [], {}, {}, threading.Lock()

    def __call__(self, study, spec):
        kind = type(spec)
        with self.lock:
            self.begun.append(spec.name)
            self.now[kind] = self.now.get(kind, 0) + 1
            self.most[kind] = max(self.most.get(kind, 0), self.now[kind])
        threading.Event().wait(0.05)
        with self.lock:
            self.now[kind] -= 1
        if spec.name == self.fail:
            raise KeyboardInterrupt
        return ReportRow(spec.name, "some", state="not kept")


@pytest.mark.parametrize(("cores", "elements", "learners"), [(2, 1, 1), (4, 2, 2), (16, 2, 5)])
def test_learners_run_in_parallel_on_spare_cores(study, cores, elements, learners):
    run = Rows()
    assert [row.name for row in measure_rows(study, SPECS, run, cores)] == [spec.name for spec in SPECS]
    assert run.most[FemVariant] == elements and run.most[LearnerSpec] == learners


@pytest.mark.parametrize(("cores", "learners"), [(4, 2), (16, 4)])
def test_learners_run_together_with_fem_on_a_gpu(study, cores, learners):
    run = Rows()
    found = [row.name for row in measure_rows(study, SPECS, run, cores, uses_gpu=True)]
    assert found == [spec.name for spec in SPECS] and run.most == {FemVariant: 2, LearnerSpec: learners}
    begun_first = {spec.name for spec in SPECS[:4]}
    assert (set(run.begun[:4]) == begun_first) is (cores == 4)


def test_interrupted_gpu_measurement_ends_the_learners(study):
    run, many = Rows("fem 1"), tuple(LearnerSpec(f"learner {k}") for k in range(200))
    with pytest.raises(KeyboardInterrupt):
        list(measure_rows(study, (*SPECS[:4], *many), run, 16, uses_gpu=True))
    assert len([name for name in run.begun if name.startswith("learner")]) < len(many)


def test_rows_in_this_process_are_measured_one_by_one(study, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 16)
    run = Rows()
    assert len(list(measure_rows(study, SPECS, run))) == len(SPECS)
    assert run.most == {FemVariant: 1, LearnerSpec: 1}


@pytest.mark.parametrize("cores", [2, 16])
def test_no_row_starts_after_an_interruption(study, cores):
    run = Rows("learner 1")
    with pytest.raises(KeyboardInterrupt):
        list(measure_rows(study, SPECS, run, cores))
    under_way = 0 if cores == 2 else 5
    assert set(run.begun) <= {spec.name for spec in SPECS[: 6 + under_way]}
    assert {spec.name for spec in SPECS[:6]} <= set(run.begun)


def test_row_process_reports_error_and_releases_its_turn(study, tmp_path):
    """An unknown law is reported in the state of the row."""
    turns = []

    @contextmanager
    def turn():
        turns.append("begins")
        yield
        turns.append("ends")

    row = measure_in_process(turn(), study, FemVariant("FEM odd law", law="odd"))
    assert turns == ["begins", "ends"] and "odd" in row.state and row.state != "measured"


def test_row_process_prints_no_output_of_warp():
    """Such lines would precede the line of --json."""
    code = (
        "from types import SimpleNamespace as Study; from scenes.report.rows import prepare_rows\n"
        "prepare_rows('cpu', Study(on_card=False)); import warp as wp; wp.zeros(1, device='cpu')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""
