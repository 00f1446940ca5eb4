"""`sulcus report`: held-out loads do not influence the training of a row."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from poison import poisoned
from studies import study_of

from scenes.report.learner import LearnerSpec, measure_learner
from sim.runtime.threads import limit_to_one_thread
from surrogate.training.expansion import Expansion


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    box = make_box((6, 6, 4), tumour=9e-3, depth=14e-3, opening=20e-3)
    return study_of(tmp_path_factory.mktemp("report"), box, 100)


@pytest.mark.parametrize("name", ["linear", "series-gp"])
def test_held_out_solutions_do_not_influence_training(study, tmp_path, name, monkeypatch):
    """Bitwise equal after a new tabulation: wrong held-out solutions change only the error figures."""
    monkeypatch.setattr("scenes.report.learner.list_counts", lambda most: [])
    monkeypatch.setattr("scenes.report.learner.compute_coverage_beyond", lambda *known: {})
    path, _ = poisoned(study.data, tmp_path / "data.h5", np.flatnonzero(study.dataset.good)[study.disc_split.test_mask])
    found = []
    for data, folder in ((study.data, "as-it-is"), (path, "wild")):
        here = replace(study, data=data)
        kept = tmp_path / folder / "series.npz"
        vars(here)["expansion"] = Expansion(here.dataset, "cpu", table_path=kept)
        with limit_to_one_thread():
            found.append(measure_learner(here, LearnerSpec(name)))
    row, wild = found
    assert row.load_mm == wild.load_mm and len(row.load_mm) == len(study.test_loads)
    assert wild.own_fem["discs"].mm.mean > 1.0 > row.own_fem["discs"].mm.mean
    assert replace(wild.own_fem["beyond"], percent=None) == replace(row.own_fem["beyond"], percent=None)
