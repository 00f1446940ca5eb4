"""Tests of studies after debulking: mesh, loads solved again, learners trained again and recorded time."""

import numpy as np
import pytest
from studies import nothing

from scenes.report.adaptation import build_debulked_study, debulk_tumour, read_simulation_seconds, simulate_debulked
from scenes.report.learner import LearnerSpec
from scenes.report.rows import measure_row
from surrogate.training.train import train


class TestAdapting:
    def test_debulk_tumour_removes_a_fifth_of_the_tumour(self, study_box):
        after = debulk_tumour(study_box)
        volume = [body.mesh.volumes[body.mesh.region == 2].sum() for body in (after, study_box)]
        element = study_box.mesh.volumes[study_box.mesh.region == 2].max()
        assert 0.8 * volume[1] <= volume[0] <= 0.8 * volume[1] + element
        assert after.mesh.volumes.sum() == pytest.approx(study_box.mesh.volumes.sum() - volume[1] + volume[0])
        assert len(np.unique(after.mesh.tets)) == len(after.mesh.nodes)
        for name in ("fixed", "slide_normal"):
            known = {
                tuple(place): tuple(value)
                for place, value in zip(study_box.mesh.nodes, getattr(study_box, name), strict=True)
            }
            ours = zip(after.mesh.nodes, getattr(after, name), strict=True)
            assert all(known[tuple(place)] == tuple(value) for place, value in ours)
        np.testing.assert_array_equal(
            after.mesh.nodes[after.craniotomy], study_box.mesh.nodes[study_box.craniotomy]
        )  # the cavity is inside

    def test_debulked_study_solves_all_loads_and_retrains_learners(self, study, study_rows):
        reported = []
        simulate_debulked(study, reported.append)
        simulate_debulked(study, reported.append)
        rows_in_all = len(study.dataset.loads) + len(study.dataset.unit_good)
        assert sum(reported) == 2 * rows_in_all
        row = measure_row(study, LearnerSpec("linear"))
        after = build_debulked_study(study)
        model = train(after.dataset, ["linear"], split=after.disc_split).models["linear"]
        test = np.flatnonzero(after.disc_split.test_mask)
        guess = model.deform(after.converged.select(test), at=after.anatomy.tumour_nodes).displacement
        wanted = 1e3 * np.linalg.norm(guess - after.data_displacement[test], axis=2).mean()
        assert row.adapted.mm.mean == pytest.approx(wanted, rel=1e-6)
        assert row.adapt > read_simulation_seconds(study) > 0.0
        assert study_rows[0].adapt > 0.0 and study_rows[0].adapted is None
        assert any("L-BFGS" in line for line in study_rows[0].plan) and not row.plan
        assert study_rows[2].adapt is None  # no data of the debulked body yet

    def test_interrupted_simulation_has_time_of_all_solves(self, study, monkeypatch):
        path = build_debulked_study(study).data
        path.unlink(missing_ok=True)

        def stopped(done):
            if done:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            simulate_debulked(study, stopped)
        simulate_debulked(study, nothing)
        assert path.exists() and read_simulation_seconds(study) > 0.0
