"""Gaussian posterior of observed points compared with closed formulas, random draws and outliers."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from scipy.stats import multivariate_normal

from sim.geometry.locate import LocatedPoints
from surrogate.locating.causes import SWELLING, TOOL
from surrogate.locating.evidence import SHIFT_ERROR, SIGMA, SLIPPED_ERROR, TURN_PER_SHIFT, build_motion_evidence
from surrogate.locating.observation import Observation, to_deformed_evidence
from surrogate.locating.posterior import POSTERIOR, ObservedPrior, Posterior, build_observed_prior, condition_prior
from surrogate.locating.prior import CAUSE_SETS, NO_PLACE, OTHER_CAUSES, PLACE_SETS, RIGID_RATIOS, MotionPrior
from surrogate.locating.whitened import whiten_system

POINTS = 30


@pytest.fixture(scope="module")
def prior():
    """Smooth random motions of a box as shapes of every cause in three skulls, and of tools on two places."""
    random, box = np.random.default_rng(0), make_box()
    labels = [(kind, skull, NO_PLACE) for kind in OTHER_CAUSES for skull in range(3)]
    labels += [(TOOL, skull, place) for skull in range(2) for place in (NO_PLACE, 0, 1)]
    kind, skull, place = np.repeat(np.array(labels), 3, axis=0).T
    wave = random.normal(scale=60.0, size=(len(kind), 3))
    shape = np.sin(box.mesh.nodes @ wave.T + random.uniform(0, 6, len(kind))).T[:, :, None]
    shape = 1e-3 * shape * random.normal(size=(len(kind), 1, 3))
    centre = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])
    return MotionPrior(box, shape.astype(np.float32), kind, skull, place, centre)


def seen(prior, motion, count=POINTS):
    """Some vertices as points that are seen to move."""
    some = np.random.default_rng(9).permutation(len(motion))[:count]
    place = LocatedPoints(np.repeat(some[:, None], 4, axis=1), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))
    return build_motion_evidence(place, prior.anatomy.mesh.nodes[some], motion[some], np.full(count, SIGMA))


# Of a rigid error, as it is unless something else is known.
RIGID = np.repeat([SHIFT_ERROR, TURN_PER_SHIFT * SHIFT_ERROR], 3)


def drawn(prior, random, number=0):
    """Weights and a rigid error (r + 6,) as a hypothesis with its first place has them, and what is seen."""
    hypothesis = prior.hypotheses[number]
    unknown = np.zeros(len(prior.kind) + 6)
    unknown[hypothesis.rows] = 3.0 * hypothesis.deviations * random.standard_normal(len(hypothesis.rows))
    unknown[hypothesis.place_rows[:1]] = 3.0 * random.standard_normal(3)
    unknown[-6:] = hypothesis.rigid_ratio * RIGID * random.standard_normal(6)
    evidence = seen(prior, np.tensordot(unknown[:-6], prior.shape, 1))
    noise = np.linalg.cholesky(evidence.compute_covariance()) @ random.standard_normal(len(evidence))
    return unknown, replace(evidence, motion=evidence.motion + evidence.rigid_jacobian @ unknown[-6:] + noise)


def seen_unknowns(prior, evidence):
    """What unit weights, and a rigid error of one standard deviation, do at the points (m, r + 6)."""
    moved = np.einsum("mc,rmci->rmi", evidence.location.weights, prior.shape[:, evidence.location.vertices])
    return np.hstack([np.einsum("rmi,mi->mr", moved, evidence.axis), evidence.rigid_jacobian * evidence.rigid_scale])


def test_projected_shapes_equal_their_motion_at_the_points(prior):
    evidence = seen(prior, np.zeros((len(prior.anatomy.mesh.nodes), 3)))
    found = np.hstack([prior.project_shapes(*evidence.weights), evidence.rigid_jacobian * evidence.rigid_scale])
    assert found == pytest.approx(seen_unknowns(prior, evidence), abs=1e-9)


def test_rigid_bias_at_points_matches_evidence_rows(prior):
    evidence = drawn(prior, np.random.default_rng(3))[1]
    found = Posterior(evidence, [], np.arange(1.0, 7.0), 1.0, np.zeros(0, int), 0.0, 0.0)
    own = np.einsum("mi,mi->m", found.compute_bias(evidence.positions), evidence.axis)
    assert own == pytest.approx(evidence.rigid_jacobian @ found.rigid_error, abs=1e-12)


def test_point_cloud_is_placed_without_its_rigid_error(prior):
    body, shift = prior.anatomy, np.array([[4e-3, -2e-3, 0.0]])
    open_nodes = body.mesh.nodes[np.unique(body.open_surface)]
    rest = open_nodes[np.linalg.norm(open_nodes - open_nodes.mean(axis=0), axis=1) < 10e-3]
    still, number = np.zeros_like(body.mesh.nodes), np.arange(len(rest))
    found = to_deformed_evidence(
        body, Observation(rest + shift), number, still, lambda at: np.tile(shift, (len(at), 1))
    )
    assert len(rest) > 3 and found.positions == pytest.approx(rest, abs=1e-9)


def test_hypotheses_cover_all_causes_skulls_and_tools(prior):
    assert len(prior.hypotheses) == 3 * len(CAUSE_SETS) * len(RIGID_RATIOS)
    taking = set()
    for number, hypothesis in enumerate(prior.hypotheses):
        kinds, skull = prior.kind[hypothesis.rows], number // (len(RIGID_RATIOS) * len(CAUSE_SETS))
        taking.add((skull, tuple(sorted(set(kinds.tolist())))))
        assert set(prior.skull[hypothesis.rows[kinds != TOOL]]) <= {skull}
        pressed = set(prior.skull[hypothesis.rows[kinds == TOOL]]) | set(prior.skull[hypothesis.place_rows.ravel()])
        assert pressed == {min(skull, 1)}, "a skull that lets go is pressed as one in which the brain slides"
        causes = tuple(sorted(set(kinds.tolist()) - {TOOL}))
        assert len(hypothesis.place_rows) == (2 if causes in PLACE_SETS else 0)
    assert taking == {(skull, tuple(sorted((*some, TOOL)))) for skull in range(3) for some in CAUSE_SETS}
    assert {hypothesis.rigid_ratio for hypothesis in prior.hypotheses} == {0.1, 1.0, np.inf}


@pytest.mark.parametrize("single", [False, True])
def test_posterior_matches_normal_equations_and_evidence(prior, single):
    """Bayes' formula with precisions instead of covariances, and the evidence, with and without a tool place.

    Cases: complete motions, and one row less, with unequal axes. One skull model has fewer shapes of swelling.
    """
    _, evidence = drawn(prior, np.random.default_rng(1), 3)
    evidence = evidence.select(np.arange(len(evidence) - single))
    kept = np.ones(len(prior.kind), bool)
    kept[np.flatnonzero((prior.kind == SWELLING) & (prior.skull == 1))[1:]] = False
    prior = replace(prior, **{name: getattr(prior, name)[kept] for name in ("shape", "kind", "skull", "place")})
    sight = build_observed_prior(prior, evidence)
    noise = evidence.compute_covariance(np.sqrt((evidence.motion**2).sum() / POINTS))
    unknown = seen_unknowns(prior, evidence).T
    logs, density = [], []
    for hypothesis, found in zip(prior.hypotheses, sight.log_evidence, strict=True):
        pressed, rigid = len(hypothesis.place_rows), min(hypothesis.rigid_ratio, SLIPPED_ERROR / SHIFT_ERROR)
        assert np.isfinite(found[: 1 + pressed]).all() and (found[1 + pressed :] == -np.inf).all()
        for number, log in enumerate(found[: 1 + pressed]):
            place = hypothesis.place_rows[number - 1] if number else np.zeros(0, int)
            answer = sight.compute_posterior(hypothesis, place, 1.0)
            size = np.concatenate(
                [sight.motion_size * hypothesis.deviations, np.full(6, rigid), np.full(len(place), sight.motion_size)]
            )
            some = unknown[answer.rows]
            spread = np.linalg.inv(some @ np.linalg.solve(noise, some.T) + np.diag(size**-2.0))
            assert answer.root.T @ answer.root == pytest.approx(spread, rel=1e-4, abs=1e-8)
            mean = spread @ some @ np.linalg.solve(noise, evidence.motion)
            assert answer.mean == pytest.approx(mean, rel=1e-4, abs=1e-6)
            logs.append(log)
            density.append(multivariate_normal(cov=noise + (some.T * size**2) @ some).logpdf(evidence.motion))
    assert POSTERIOR.evidence_divisor * np.diff(logs) == pytest.approx(np.diff(density), rel=1e-4, abs=1e-4)


def test_whitening_by_axis_equals_whitening_of_all_rows(prior):
    """The fast method for points with three equal axes agrees with the general method."""
    _, evidence = drawn(prior, np.random.default_rng(2))
    short = evidence.build_whitening(1e-3)
    turned = evidence.select(np.random.default_rng(0).permutation(len(evidence)))
    long = turned.build_whitening(1e-3)
    assert (short.axis_count, long.axis_count) == (3, 1)
    for one, other in ((short, evidence), (long, turned)):
        inverse = np.linalg.inv(other.compute_covariance(1e-3))
        rows = np.random.default_rng(1).standard_normal((len(other), 2))
        white = one.whiten(rows)
        assert white.T @ white == pytest.approx(rows.T @ inverse @ rows)
        assert one.transform_back(white) == pytest.approx(inverse @ rows)
        table = np.arange(len(other)).reshape(-1, 3)
        assert one.compute_precision(table) == pytest.approx(
            inverse[table[:, :, None], table[:, None]], abs=1e-6 * inverse.max()
        )


@pytest.mark.parametrize("count", [12, 90])
def test_block_rows_match_products_of_all_points(prior, count):
    """Fewer and more points than vertices, with whole motions and single rows."""
    box, random = prior.anatomy, np.random.default_rng(0)
    some = random.integers(40, size=(count, 4))
    place = LocatedPoints(box.mesh.tets[some[:, 0]], random.dirichlet(np.ones(4), count))
    at = np.einsum("nc,nci->ni", place.weights, box.mesh.nodes[place.vertices])
    whole = build_motion_evidence(place, at, 1e-3 * random.standard_normal((count, 3)), np.full(count, SIGMA))
    for evidence in (whole, whole.select(random.permutation(len(whole)))):
        found, unknown = whiten_system(prior, evidence, 1e-3), seen_unknowns(prior, evidence)
        rows = np.column_stack([unknown, evidence.motion])
        precise = np.linalg.solve(evidence.compute_covariance(1e-3), rows)
        assert found.products == pytest.approx(rows.T @ precise, abs=1e-9 * np.abs(rows.T @ precise).max())
        columns = random.permutation(rows.shape[1])[:9]
        for some in (columns, np.append(columns, rows.shape[1] - 1)):
            assert found.apply_precision(some) == pytest.approx(precise[:, some], abs=1e-9 * np.abs(precise).max())


def test_posterior_ellipsoids_have_chi_square_coverage(prior):
    random, hypothesis, square = np.random.default_rng(3), prior.hypotheses[3], []
    for _ in range(200):
        truth, evidence = drawn(prior, random, 3)
        # What shapes lack is no part of these draws, and their size is known.
        sight = ObservedPrior(prior, 3.0, whiten_system(prior, evidence, 0.0), np.zeros(3))
        answer = sight.compute_posterior(hypothesis, hypothesis.place_rows[0], 1.0)
        scale = np.append(np.ones(len(prior.kind)), RIGID)
        off = answer.mean - (truth / scale)[answer.rows]
        square.append(off @ np.linalg.solve(answer.root.T @ answer.root, off))
    degrees = len(answer.rows)
    assert np.mean(square) == pytest.approx(degrees, abs=4.0 * np.sqrt(2.0 * degrees / 200))


def test_mixture_moments_match_its_hypotheses(prior):
    _, evidence = drawn(prior, np.random.default_rng(4))
    found = condition_prior(prior, evidence)
    assert not len(found.outliers) and 0.2 < found.surprise < 1.6
    answers = build_observed_prior(prior, evidence).compute_posteriors()
    assert len(answers) == POSTERIOR.max_hypotheses and sum(answer.probability for answer in answers) == pytest.approx(
        1.0
    )
    means = np.zeros((len(answers), len(prior.kind) + 6))
    spreads = np.zeros((len(answers), *2 * means.shape[1:]))
    for mean, spread, answer in zip(means, spreads, answers, strict=True):
        mean[answer.rows] = answer.mean
        spread[np.ix_(answer.rows, answer.rows)] = answer.root.T @ answer.root
    share = np.array([answer.probability for answer in answers])
    assert (np.diff(share) <= 0.0).all()
    mean = share @ means
    assert np.append(found.shape_weights, found.rigid_error / RIGID) == pytest.approx(mean)
    spread = np.tensordot(share, spreads + (means - mean)[:, :, None] * (means - mean)[:, None], 1)[:-6, :-6]
    some = prior.shape[:, ::40].astype(float)
    covariance = np.einsum("rvi,rs,svj->vij", some, spread, some)
    assert found.compute_covariance(some) == pytest.approx(covariance, abs=1e-9 * covariance.max())
    assert replace(found, covariance_factor=2.5).compute_covariance(some) == pytest.approx(
        2.5 * covariance, abs=1e-9 * covariance.max()
    )


def test_gross_errors_are_excluded_and_reported(prior):
    truth, evidence = drawn(prior, np.random.default_rng(5))
    wrong = np.isin(evidence.point, [3, 11, 24])
    spoilt = replace(evidence, motion=evidence.motion + np.where(wrong, 0.03, 0.0))
    found, clean = condition_prior(prior, spoilt), condition_prior(prior, evidence)
    assert found.outliers.tolist() == [3, 11, 24] and not len(clean.outliers)
    off, without = (
        np.linalg.norm((each.shape_weights - truth[:-6]) @ prior.centroid_motion) for each in (found, clean)
    )
    assert off < 2.0 * without + 0.3e-3


@pytest.mark.parametrize(("deviations", "left_out"), [(2.3, []), (4.2, [7])])
def test_points_beyond_1e_4_probability_are_excluded(prior, deviations, left_out):
    """The root of chi-square (3 degrees of freedom) is 4.6 at 1e-4, and 7.9 at 1e-12."""
    still = seen(prior, np.zeros(prior.anatomy.mesh.nodes.shape))
    far = np.where(still.point == 7, deviations * still.sigma / np.sqrt(3.0), 0.0)
    found = condition_prior(prior, replace(still, motion=still.motion + far))
    assert found.outliers.tolist() == left_out


def test_outlier_observed_along_one_axis_is_excluded(prior):
    """Motions along one axis only, as in a cloud."""
    _, evidence = drawn(prior, np.random.default_rng(6))
    single = replace(evidence.select(np.arange(0, len(evidence), 3)), point=np.arange(POINTS))
    assert not len(condition_prior(prior, single).outliers)
    wrong = np.arange(POINTS) == 7
    found = condition_prior(prior, replace(single, motion=single.motion + np.where(wrong, 0.05, 0.0)))
    assert found.outliers.tolist() == [7] and np.isfinite(found.shape_weights).all()


def test_motion_outside_the_prior_gives_large_surprise(prior):
    motion = 0.01 * np.random.default_rng(7).standard_normal(prior.anatomy.mesh.nodes.shape)
    found = condition_prior(prior, seen(prior, motion))
    assert found.surprise > 2.5 or len(found.outliers) > 10


def test_tool_place_odds_decrease_with_tip_distance(prior):
    """The odds of a place decrease with its distance from the nearest tip; without tips all are equal."""
    _, evidence = drawn(prior, np.random.default_rng(8))
    without, near = (
        build_observed_prior(prior, evidence),
        build_observed_prior(prior, evidence, np.array([[0.02, 0.004, 0.0], [1.0, 1.0, 1.0]])),
    )
    assert not without.log_odds.any()
    assert near.log_odds == pytest.approx([np.log(0.05), -0.5 * (0.02**2 + 0.004**2) / 0.004**2, -0.5])
    assert near.log_evidence[0] - without.log_evidence[0] == pytest.approx(near.log_odds)
    assert near.log_evidence[-1, 0] - without.log_evidence[-1, 0] == pytest.approx(
        near.log_odds[0]
    )  # with which no tool may press


def test_prior_scale_includes_rigid_error(prior):
    """Motion may be as large as the rigid error, whose prior translation has a length of 1.4 mm."""
    little, much = (seen(prior, np.full_like(prior.anatomy.mesh.nodes, each)) for each in (1e-5, 3e-3))
    assert build_observed_prior(prior, little).motion_size == pytest.approx(np.sqrt(3.0) * 0.8, rel=1e-3)
    assert build_observed_prior(prior, much).motion_size == pytest.approx(np.sqrt(3.0 * (3.0**2 + 0.8**2)), rel=1e-3)
    exact = replace(much, shift_sigma=0.0)
    assert build_observed_prior(prior, exact).motion_size == pytest.approx(np.sqrt(3.0) * 3.0, rel=1e-3)


def test_estimated_rigid_error_follows_reported_size(prior):
    """A shift above the reported error moves the tumour; with zero reported error none is estimated."""
    truth, evidence = drawn(prior, np.random.default_rng(10), 3)
    shifted = replace(evidence, motion=evidence.motion + evidence.rigid_jacobian[:, :3] @ [2e-3, -2e-3, 2e-3])
    off, bias = [], []
    for shift in (0.0, 0.2e-3, 2e-3):
        found = condition_prior(prior, replace(shifted, shift_sigma=shift))
        off.append(np.linalg.norm((found.shape_weights - truth[:-6]) @ prior.centroid_motion))
        bias.append(np.linalg.norm(found.rigid_error[:3]))
    assert bias[0] < 1e-5 and bias[1] < 0.5 * bias[2] and off[2] < 0.5 * off[0]
