"""Conformal error bounds: coverage in each force class, and growth outside the training range."""

from dataclasses import replace

import numpy as np
import pytest

from surrogate.model.conformal import (
    LEVELS,
    MAX_GROWTH,
    USUAL_GROWTH,
    BoundSettings,
    compute_conformal_quantile,
    fit_bound,
    fit_growth,
)
from surrogate.model.training_range import Excess


def lying(count, away=0.0, beyond=0.0):
    """So many loads at a distance [m] from the nearest training load, and so far beyond their range otherwise."""
    return Excess(np.full(count, away), np.full(count, beyond), np.full(count, beyond))


def drawn(count, seed):
    """Features, forces and largest errors, which grow steeply with force and with the third feature."""
    random = np.random.default_rng(seed)
    features = random.normal(size=(count, 4))
    force = np.exp(0.6 * features[:, 0] - 2.0)
    size = 1e-4 * np.exp(2.0 * features[:, 0] + 0.7 * features[:, 2] ** 2) * random.gamma(2.0, size=count)
    return features, force, size * random.uniform(0.5, 1.0, count)


@pytest.fixture(scope="module")
def bound():
    features, _, error = drawn(600, 0)
    return fit_bound((features, error), *drawn(2000, 1))


def test_bounds_cover_new_loads_in_every_force_class(bound):
    features, force, error = drawn(20000, 2)
    stated = bound.evaluate(features, force, lying(len(force)))
    covered = error <= stated
    for level, row in zip(LEVELS, covered, strict=True):
        assert abs(row.mean() - level) < 0.01
    decile = np.searchsorted(np.quantile(force, np.arange(1, 10) / 10), force)
    assert all(abs(covered[0][decile == k].mean() - 0.95) < 0.045 for k in range(10))
    # Bounds that know nothing of the load would be an error's 95th percentile: five times its median and more.
    assert np.median(stated[0] / error) < 4.0
    assert (stated[1] >= stated[0]).all()


def test_bound_grows_outside_the_training_range(bound):
    features, force, _ = drawn(10, 3)
    inside, outside = (bound.evaluate(features, force, lying(10, beyond=excess)) for excess in (0.0, 1.0))
    assert (outside > 2.0 * inside).all()
    near = replace(bound, growth=np.array(500.0), near=np.array(1e-3))  # its first millimetre does not count
    assert near.evaluate(features, force, lying(10, 3e-3)) == pytest.approx(2.0 * inside)
    assert near.evaluate(features, force, lying(10, 0.9e-3)) == pytest.approx(inside)


def far_and_near(growth, seed, near=400, far=300):
    """Errors over a plain bound, and distances [m] to training loads, of which the errors grow by `growth` [1/m]."""
    random = np.random.default_rng(seed)
    for count, most in ((near, 1e-3), (far, 6e-3)):
        away = random.uniform(0.0, most, count)
        yield 0.4 * random.exponential(size=count) * (1.0 + growth * away), away


@pytest.mark.parametrize("growth", [0.0, 300.0, 1500.0])
def test_fitted_growth_matches_error_growth_with_distance(growth):
    found = np.array([fit_growth(*far_and_near(growth, seed)) for seed in range(20)])
    assert abs(np.median(found) - growth) < 0.3 * growth + 40.0


def test_too_few_far_loads_give_default_growth():
    near, far = far_and_near(300.0, 0)
    assert fit_growth(near, (far[0][:18], far[1][:18])) == USUAL_GROWTH
    assert fit_growth(near, (1e9 * far[0], far[1])) == MAX_GROWTH


def test_growing_bounds_cover_near_and_far_loads():
    features, force, error = drawn(3000, 5)
    away = np.random.default_rng(6).uniform(0.0, 6e-3, 3000)
    error = error * (1.0 + 800.0 * away)
    near = np.flatnonzero(away < 2e-3)
    known = features[near], force[near], error[near]
    bound = fit_bound((features, error), *known, distance=away[near], growth=800.0)
    stated = bound.evaluate(features, force, Excess(away, 0.0 * away, 0.0 * away))[0]
    held = error <= stated
    assert abs(held[near].mean() - 0.95) < 0.02 and abs(held[away > 4e-3].mean() - 0.95) < 0.03


def test_conformal_quantile_has_finite_sample_rank():
    values = np.arange(1.0, 100.0)  # 99 of them
    assert compute_conformal_quantile(values, 0.95) == 95.0 and compute_conformal_quantile(values, 0.99) == 99.0
    assert compute_conformal_quantile(values[:9], 0.95) == np.inf


def test_loads_of_equal_force_form_one_class():
    features, _, error = drawn(500, 4)
    bound = fit_bound((features, error), features, np.full(500, 0.2), error)
    assert not len(bound.edges) and bound.quantile.shape == (2, 1)
    stated = bound.evaluate(features, np.full(500, 0.2), lying(500))
    assert np.mean(error <= stated[0]) >= 0.95


def placed(count, seed, discs=None):
    """As `drawn`, features of a load and a place, the error known by the load alone; places in few discs, if asked."""
    random = np.random.default_rng(seed)
    load, place = random.normal(size=(count, 4)), random.uniform(-20.0, 20.0, (count, 3))
    if discs is not None:
        place = discs[random.integers(len(discs), size=count)] + random.normal(size=(count, 3))
    size = 1e-4 * np.exp(1.2 * load[:, 0] - 0.8 * load[:, 1]) * random.exponential(size=count)
    return np.hstack([load, place]), np.exp(0.6 * load[:, 0] - 2.0), size


@pytest.mark.parametrize("curved", [True, False])
def test_bound_scale_from_few_discs_is_bounded_between_them(curved):
    discs = np.array([[-12.0, -9.0, 5.0], [2.0, 11.0, -8.0], [13.0, -4.0, 9.0]])
    features, _, error = placed(400, 5, discs)
    bound = fit_bound((features, error), *placed(1000, 6), BoundSettings(allow_quadratic=curved))
    features, force, error = placed(5000, 7)
    stated = bound.evaluate(features, force, lying(len(force)))
    assert abs(np.mean(error <= stated[0]) - 0.95) < 0.02
    # The 95th percentile of an exponential distribution is three times its mean.
    ideal = 3e-4 * np.exp(1.2 * features[:, 0] - 0.8 * features[:, 1])
    assert np.quantile(stated[0] / ideal, 0.99) < 4.0


@pytest.mark.parametrize("curved", [True, False])
def test_bound_scale_is_independent_of_contact_position(curved):
    features, _, error = placed(400, 5)
    bound = fit_bound((features, error), *placed(1000, 6), BoundSettings(allow_quadratic=curved))
    elsewhere = features + [0.0, 0.0, 0.0, 0.0, 9.0, -9.0, 30.0]
    at = [bound.evaluate(some, np.full(400, 0.2), lying(400)) for some in (features, elsewhere)]
    np.testing.assert_array_equal(*at)
