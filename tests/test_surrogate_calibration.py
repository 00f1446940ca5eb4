"""Calibration of covariances: covering factor, and trials on patches of the cortex."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from scipy.stats import chi2

from sim.errors import InputError
from surrogate.locating import calibration
from surrogate.locating.calibration import (
    NEAREST_TRIALS,
    assign_folds,
    compute_coverage_factor,
    compute_similarity_features,
    is_within_trials,
    run_trials,
    sample_observed_patch,
)
from surrogate.locating.ensemble import Ensemble
from surrogate.locating.prior import compute_centroid_motion

MOTION = np.array([1e-3, -2e-3, 2e-3])


@pytest.fixture(scope="module")
def body():
    return make_box(cells=(8, 8, 5), spacing=9e-3, tumour=12e-3, opening=30e-3)


@pytest.fixture(scope="module")
def evidence(body):
    motion = np.tile(MOTION, (len(body.mesh.nodes), 1))
    return sample_observed_patch(body, motion, np.random.default_rng(0), 60, 0.5)


def test_sampled_patch_points_lie_on_the_open_cortex(body, evidence):
    assert len(evidence) == 180 and evidence.motion.reshape(60, 3) == pytest.approx(np.tile(MOTION, (60, 1)))
    places = evidence.positions[::3]
    on = body.mesh.nodes[np.unique(body.open_surface)]
    assert np.ptp(places[:, 2]) == pytest.approx(0.0, abs=1e-12) and places[0, 2] == pytest.approx(on[:, 2].max())
    whole = sample_observed_patch(body, np.zeros_like(body.mesh.nodes), np.random.default_rng(0), 400, 1.0).positions
    assert np.ptp(places[:, :2], axis=0).max() < 0.95 * np.ptp(whole[:, :2], axis=0).max()
    triangles = np.unique(np.sort(evidence.location.vertices[:, :3], axis=1), axis=0)
    share = len(triangles) / len(body.open_surface)  # all of one size
    assert 0.3 < share <= 0.5
    moved = np.einsum("mc,mci->mi", evidence.location.weights, body.mesh.nodes[evidence.location.vertices])
    assert moved == pytest.approx(evidence.positions)


def test_likeness_uses_relative_motion_and_point_count(evidence):
    exact, shifted = (replace(evidence, sigma=np.full(180, 3e-4), shift_sigma=shift) for shift in (0.0, 4e-4))
    assert compute_similarity_features(exact)[:2] == pytest.approx(np.log([3e-3 / 3e-4, 60.0]))
    assert compute_similarity_features(shifted)[:2] == pytest.approx(np.log([3e-3 / 5e-4, 60.0]))


def test_likeness_uses_patch_size_not_point_count(body, evidence):
    """Doubling the width changes only the size term, equally for few and many points; less area gives a smaller one."""
    wide = replace(evidence, positions=2.0 * evidence.positions)
    few, many = (
        compute_similarity_features(wide.select(np.arange(n)))
        - compute_similarity_features(evidence.select(np.arange(n)))
        for n in (60, 180)
    )
    assert few == pytest.approx(many) and few[2] > 1.0 and few[[0, 1, 3]] == pytest.approx(np.zeros(3))
    still, sizes = np.zeros_like(body.mesh.nodes), []
    for cover in (0.2, 0.4, 0.8):
        sizes.append(
            [
                compute_similarity_features(sample_observed_patch(body, still, np.random.default_rng(n), 60, cover))[2]
                for n in range(5)
            ]
        )
    assert max(sizes[0]) < min(sizes[1]) and max(sizes[1]) < min(sizes[2])


def test_covering_factor_follows_trials_of_similar_patches(evidence):
    small = replace(evidence, positions=0.5 * evidence.positions)
    tried = np.concatenate(
        [
            np.tile(np.append(compute_similarity_features(of), square), (NEAREST_TRIALS, 1))
            for of, square in ((evidence, 1.0), (small, 9.0))
        ]
    )
    assert compute_coverage_factor(tried, small) == pytest.approx(9.0 * compute_coverage_factor(tried, evidence))


def test_cloud_likeness_differs_from_named_points(evidence):
    """A cloud has one row per point, named points have three."""
    cloud = evidence.select(np.arange(0, 180, 3))
    assert np.array_equal(compute_similarity_features(cloud)[1:3], compute_similarity_features(evidence)[1:3])
    assert compute_similarity_features(cloud)[3] > 100.0 + compute_similarity_features(evidence)[3]
    named, unnamed = (
        np.tile(np.append(compute_similarity_features(of), square), (NEAREST_TRIALS, 1))
        for of, square in ((evidence, 1.0), (cloud, 9.0))
    )
    tried = np.concatenate([named, unnamed])
    assert compute_coverage_factor(tried, cloud) == pytest.approx(9.0 * compute_coverage_factor(tried, evidence))
    assert is_within_trials(named, evidence) and not is_within_trials(named, cloud) and is_within_trials(tried, cloud)


def some_members(body, skull, group):
    """Motions that do not matter, in such skulls and groups."""
    count = len(group)
    still = np.zeros((count, *body.mesh.nodes.shape), np.float32)
    return Ensemble(body, still, np.zeros(count, int), np.array(skull), np.array(group))


def test_held_out_folds_take_whole_groups_of_each_skull(body):
    """The tissue of a trial is unknown to its estimator; every estimator knows each skull model."""
    some = some_members(body, [0, 0, 0, 0, 0, 1, 1, 1, 2, 2], [0, 0, 1, 1, 2, 3, 4, 4, 5, 5])
    turn = assign_folds(some)
    assert turn.tolist() == [0, 0, 1, 1, 2, 0, 1, 1, -1, -1]
    with pytest.raises(InputError, match="several Poisson's ratios"):
        run_trials(some_members(body, [0, 0, 1], [0, 0, 1]), None)


def test_trial_prior_excludes_the_group_of_the_trial(body, monkeypatch):
    """A replaced function records the members of each prior and the member of each trial."""
    random, group = np.random.default_rng(0), np.repeat(np.arange(6), 4)
    motion = random.normal(scale=2e-3, size=(24, *body.mesh.nodes.shape)).astype(np.float32)
    ensemble = Ensemble(body, motion, np.tile([0, 1], 12), group // 2, group)
    known, made, clouds = [], [], []
    monkeypatch.setattr(calibration, "build_prior", lambda ensemble, presses, mask: known.append(mask))

    def middle(anatomy, moved):
        made.append((known[-1], moved[0]))
        return compute_centroid_motion(anatomy, moved)

    def unsettled(prior, observation):
        clouds.append(observation.rest is None)
        raise InputError("no trial")

    monkeypatch.setattr(calibration, "compute_centroid_motion", middle)
    monkeypatch.setattr(calibration, "match_and_update", unsettled)
    assert not len(run_trials(ensemble, None, count=40)) and len(made) == 40 and clouds == 20 * [True, False]
    assert [sorted(set(group[~mask])) for mask in known] == [[0, 2, 4], [1, 3, 5]]
    for mask, moved in made:
        share = np.linalg.lstsq(motion.reshape(24, -1).T.astype(float), moved.ravel(), rcond=None)[0]
        assert not mask[np.abs(share) > 1e-6].any() and np.abs(share).max() > 0.5


@pytest.mark.parametrize("times", [0.5, 1.0, 4.0])
def test_covering_factor_gives_95_percent_coverage(evidence, times):
    """Chi-square squares (3 degrees of freedom) times a number require this number as factor."""
    random = np.random.default_rng(1)
    squares = times * chi2.ppf((np.arange(NEAREST_TRIALS) + 0.5) / NEAREST_TRIALS, 3)
    spread = 0.01 * random.standard_normal((NEAREST_TRIALS, 4)) * [1.0, 1.0, 1.0, 0.0]
    tried = np.column_stack([compute_similarity_features(evidence) + spread, squares])
    rank = chi2.ppf(114.5 / 120.0, 3) / chi2.ppf(0.95, 3)
    assert compute_coverage_factor(tried, evidence) == pytest.approx(times * rank) and abs(rank - 1.0) < 0.12
    # Trials that are unlike it do not count.
    other = np.column_stack([compute_similarity_features(evidence) + np.full((500, 4), 3.0), np.full(500, 1e3)])
    assert compute_coverage_factor(np.concatenate([other, tried]), evidence) == compute_coverage_factor(tried, evidence)


def test_evidence_outside_the_trials_is_detected(evidence):
    around = compute_similarity_features(evidence) + np.array([[-0.1, -0.1, -0.1, 0.0], [0.1, 0.1, 0.1, 0.0]])
    assert is_within_trials(np.column_stack([around, [1.0, 1.0]]), evidence)
    assert not is_within_trials(np.column_stack([around + [0.2, 0.0, 0.0, 0.0], [1.0, 1.0]]), evidence)
    assert not is_within_trials(np.column_stack([around - [0.0, 0.2, 0.0, 0.0], [1.0, 1.0]]), evidence)
    # A patch may be too small, and none is too large: trials lie on all of the open cortex.
    for larger, known in ((0.2, False), (-0.2, True)):
        assert is_within_trials(np.column_stack([around + [0.0, 0.0, larger, 0.0], [1.0, 1.0]]), evidence) == known


def test_tumour_centre_is_its_volume_centroid(body):
    """A motion that increases linearly with x moves the tumour by its value at the centroid."""
    inside = body.mesh.region == 2
    middle = np.average(body.mesh.nodes[body.mesh.tets[inside]].mean(axis=1), axis=0, weights=body.mesh.volumes[inside])
    motion = np.zeros((1, *body.mesh.nodes.shape))
    motion[0, :, 1] = 1.0 + 3.0 * body.mesh.nodes[:, 0]
    assert compute_centroid_motion(body, motion) == pytest.approx(np.array([[0.0, 1.0 + 3.0 * middle[0], 0.0]]))
