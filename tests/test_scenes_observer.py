"""Observations of an undeformed body: errors and seeds."""

from dataclasses import replace

import numpy as np
import pytest


def test_observations_have_the_given_errors(still):
    observer, rest = still
    seen = np.array([observer.observe(number, rest).now - observer.observe(number, rest).rest for number in range(40)])
    steady = seen.mean(axis=0)
    assert (seen - steady).std() == pytest.approx(0.3e-3, rel=0.05)
    assert np.linalg.norm(steady.mean(axis=0)) == pytest.approx(0.7e-3, abs=0.5e-3)  # the smooth one is in it
    bare = replace(observer, observation_model=replace(observer.observation_model, white=0.0, smooth=0.0))
    rigid = bare.observe(0, rest).now - bare.observe(0, rest).rest
    assert np.linalg.norm(rigid.mean(axis=0)) == pytest.approx(0.7e-3, rel=1e-6)
    turned = rigid - rigid.mean(axis=0)
    assert 0.0 < np.abs(turned).max() < 1.01 * np.radians(0.3) * np.ptp(bare.observe(0, rest).rest, axis=0).max()
    smooth = replace(
        observer, observation_model=replace(observer.observation_model, white=0.0, shift=0.0, turn=0.0)
    ).observe(3, rest)
    off = smooth.now - smooth.rest
    assert np.sqrt((off**2).mean()) == pytest.approx(0.5e-3, rel=0.5)
    apart = np.linalg.norm(smooth.rest[:, None] - smooth.rest, axis=2)
    near = (apart > 0.0) & (apart < 2e-3)
    assert np.linalg.norm(off[:, None] - off, axis=2)[near].mean() < 0.3e-3
    assert smooth.sigmas == pytest.approx(0.5e-3)


def test_observations_depend_on_seed_and_frame_only(still):
    observer, rest = still
    again = replace(observer)
    other = replace(observer, observation_model=replace(observer.observation_model, seed=1))
    assert np.array_equal(observer.observe(7, rest).now, again.observe(7, rest).now)
    assert not np.array_equal(observer.observe(7, rest).now, observer.observe(8, rest).now)
    assert not np.array_equal(observer.observe(7, rest).rest, other.observe(7, rest).rest)
