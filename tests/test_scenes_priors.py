"""Priors of tissue, skull and mesh: sources, draws and their spread."""

from dataclasses import replace

import numpy as np
import pytest
from theatres import short

from scenes.analysis.uncertainty import (
    apply_sample,
    compute_motion_errors,
    find_mesh_prior,
    get_skull_model,
    list_skulls,
    sample_mesh_errors,
)
from scenes.script.priors import POISSON, PRIORS, STIFFNESS, PatientSample, sample_priors
from scenes.script.scene import find_scene
from sim.effects import SKULLS
from sim.material import BRAIN

SAME = PatientSample(1.0, BRAIN.poisson, 1.0, 0.0, (0.0, 0.0, 0.0), 0.0)


class TestPriors:
    def test_each_prior_has_a_unique_name_meaning_and_source(self):
        assert len({prior.name for prior in PRIORS}) == len(PRIORS)
        assert all(prior.meaning and prior.source for prior in PRIORS)

    def test_samples_cover_each_prior_evenly(self):
        """One sample in each interval of equal probability."""
        found = sample_priors(20, 3)
        stiffness = np.sort([one.stiffness for one in found])
        edges = STIFFNESS.compute_quantiles(np.arange(21) / 20.0)
        assert (stiffness > edges[:-1]).all() and (stiffness < edges[1:]).all()
        poisson = np.sort([one.poisson for one in found])
        assert np.diff(POISSON.range)[0] > np.ptp(poisson) > 0.9 * np.diff(POISSON.range)[0]
        assert np.std([one.tip for one in found]) == pytest.approx(1.06e-3, rel=0.15)
        assert found == sample_priors(20, 3) != sample_priors(20, 4)

    def test_skull_models_have_equal_probability(self):
        names = [apply_sample(short(), one).effects[2] for one in sample_priors(30, 0)]
        assert [names.count(skull) for skull in SKULLS.values()] == [10, 10, 10]

    def test_skull_models_of_brain_shift_exclude_bonding(self):
        assert list_skulls(find_scene("brain_shift")) == ("slide", "contact")

    def test_mesh_error_grows_with_sliding_and_weight(self):
        press, sinking = find_scene("press"), find_scene("brain_shift")
        assert get_skull_model(press) == "bonded" and get_skull_model(sinking) == "contact"
        draws = [replace(SAME, skull=share, mesh=1.0) for share in (0.1, 0.5, 0.9)]
        np.testing.assert_allclose(sample_mesh_errors(press, draws), [0.05, 0.12, 0.12])
        np.testing.assert_allclose(sample_mesh_errors(sinking, draws), 0.25)
        loose = replace(press, effects=tuple(one for one in press.effects if one not in SKULLS.values()))
        assert get_skull_model(loose) is None
        np.testing.assert_allclose(sample_mesh_errors(loose, draws), 0.05)
        assert find_mesh_prior(sinking, "bonded").range[1] == 0.05
        motion = np.ones((3, 2, 3))
        np.testing.assert_allclose(
            compute_motion_errors(motion, motion[0], sample_mesh_errors(press, draws))[:, 0, 0], [0.05, 0.12, 0.12]
        )
