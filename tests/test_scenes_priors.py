"""Priors of tissue, skull and mesh: sources, draws and their spread."""

from dataclasses import replace

import numpy as np
import pytest
from theatres import short

from scenes.analysis.uncertainty import (
    apply_sample,
    collect_contributor_values,
    compute_motion_errors,
    find_mesh_prior,
    get_skull_model,
    list_skulls,
    sample_mesh_errors,
)
from scenes.script.priors import MEASURED_PRIORS, POISSON, PRIORS, STIFFNESS, PatientSample, list_priors, sample_priors
from scenes.script.scene import Scene, find_scene
from sim.effects import SKULLS, Elasticity
from sim.material import BRAIN, MEASURED_BRAIN, Ogden

SAME = PatientSample(1.0, BRAIN.poisson, 1.0, 0.0, (0.0, 0.0, 0.0), 0.0)


class TestPriors:
    def test_each_prior_has_a_unique_name_meaning_and_source(self):
        for priors in (PRIORS, MEASURED_PRIORS):
            assert len({prior.name for prior in priors}) == len(priors)
            assert all(prior.meaning and prior.source for prior in priors)

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


class TestLaw:
    def test_exponents_are_even_and_within_the_measured_range(self):
        drawn = [one.exponent for one in sample_priors(100, 0, MEASURED_BRAIN)]
        assert set(drawn) == {-float(n) for n in range(4, 25, 2)}
        assert drawn.count(-6.0) > 2 * drawn.count(-20.0)  # The same probability for each ratio of exponents.

    def test_sample_replaces_exponent_and_keeps_constants(self):
        sample = replace(SAME, stiffness=2.0, poisson=0.47, exponent=-6.0)
        found = sample.scale_tissue(MEASURED_BRAIN, 1.5)
        assert isinstance(found, Ogden) and [m for _, m in found.terms] == [-6.0]
        assert found.young == pytest.approx(3.0 * MEASURED_BRAIN.young)
        assert found.poisson == pytest.approx(0.47)
        assert found.limit == MEASURED_BRAIN.limit

    def test_tissue_without_negative_exponent_keeps_its_law(self):
        for tissue in (BRAIN, Ogden(((2200.0, 2.0),), 5e4)):
            assert list_priors(tissue) is PRIORS
            assert {one.exponent for one in sample_priors(8, 0, tissue)} == {None}
            changed = SAME.scale_tissue(tissue)
            assert changed.law == tissue.law

    def test_law_is_a_contributor_of_the_error(self):
        scene = replace_tissue(find_scene("press"), MEASURED_BRAIN)
        column = collect_contributor_values([replace(SAME, exponent=-10.0), SAME], scene)["brain's law"]
        np.testing.assert_allclose(column, [[np.log(0.5)], [0.0]])
        assert "brain's law" not in collect_contributor_values([SAME], find_scene("press"))


def replace_tissue(scene: Scene, tissue: Ogden) -> Scene:
    """Return the scene with the same tissue everywhere."""
    effects = tuple(Elasticity(tissue) if isinstance(one, Elasticity) else one for one in scene.effects)
    return replace(scene, effects=effects)
