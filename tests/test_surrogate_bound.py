"""Bounds: they hold as often as they say, class by class, and grow where nothing was promised."""

import numpy as np
import pytest

from surrogate.bound import LEVELS, conformal, fitted_bound


def drawn(count, seed):
    """Features, forces and errors at five vertices, which grow steeply with force and with the third feature."""
    random = np.random.default_rng(seed)
    features = random.normal(size=(count, 4))
    force = np.exp(0.6 * features[:, 0] - 2.0)
    size = 1e-4 * np.exp(2.0 * features[:, 0] + 0.7 * features[:, 2] ** 2) * random.gamma(2.0, size=count)
    return features, force, size[:, None] * np.array([1.0, 0.8, 0.5, 0.3, 0.1]) * random.uniform(0.5, 1.0, (count, 5))


@pytest.fixture(scope="module")
def bound():
    features, _, error = drawn(600, 0)
    return fitted_bound((features, error.max(axis=1)), *drawn(2000, 1))


def test_fresh_loads_are_covered_in_every_class(bound):
    features, force, error = drawn(20000, 2)
    told = bound.of(features, force, np.zeros(len(force)))
    covered = error.max(axis=1) <= told
    for level, row in zip(LEVELS, covered, strict=True):
        assert abs(row.mean() - level) < 0.01
    decile = np.searchsorted(np.quantile(force, np.arange(1, 10) / 10), force)
    assert all(abs(covered[0][decile == k].mean() - 0.95) < 0.045 for k in range(10))
    # Bounds that know nothing of the load would be an error's 95th percentile: five times its median and more.
    assert np.median(told[0] / error.max(axis=1)) < 4.0
    assert (told[1] >= told[0]).all()


def test_outside_it_grows(bound):
    features, force, _ = drawn(10, 3)
    inside, outside = (bound.of(features, force, np.full(10, excess)) for excess in (0.0, 1.0))
    assert (outside > 2.0 * inside).all()


def test_weak_vertices_have_a_small_share(bound):
    assert bound.profile.shape == (5,) and (np.diff(bound.profile[1:]) < 0).all()
    assert bound.profile[0] == pytest.approx(1.0) and bound.profile[4] < 0.2


def test_conformal_takes_the_rank_that_covers_one_more():
    values = np.arange(1.0, 100.0)  # 99 of them
    assert conformal(values, 0.95) == 95.0 and conformal(values, 0.99) == 99.0
    assert conformal(values[:9], 0.95) == np.inf


def test_loads_of_one_force_are_one_class():
    features, _, error = drawn(500, 4)
    bound = fitted_bound((features, error.max(axis=1)), features, np.full(500, 0.2), error)
    assert not len(bound.edges) and bound.quantile.shape == (2, 1)
    told = bound.of(features, np.full(500, 0.2), np.zeros(500))
    assert np.mean(error.max(axis=1) <= told[0]) >= 0.95
