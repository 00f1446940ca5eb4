"""Rounds of conditioning with new positions of points: each starts from the last result."""

from dataclasses import replace

import numpy as np
import pytest
from locators import dent, in_a_skull, locator_of

from surrogate.locating import iterated_conditioning
from surrogate.locating.observation import Observation, to_deformed_evidence
from surrogate.locating.posterior import condition_prior


@pytest.fixture(scope="module")
def prior():
    return locator_of(in_a_skull()).prior


@pytest.mark.parametrize(("named", "lost"), [(True, (0,)), (True, (1,)), (True, (0, 2)), (False, ())])
def test_each_conditioning_round_starts_from_the_last_result(prior, monkeypatch, named, lost):
    """Its motion and rigid error give new positions; unsupported tips no longer locate a tool."""
    body = prior.anatomy
    cortex = np.unique(body.open_surface)
    rest, count = body.mesh.nodes[cortex], len(cortex)
    moved = rest + dent(body, np.random.default_rng(1))[cortex] + [0.0, 0.0, 2e-3]
    off = [[0.04, 0.03, 0.09]]  # no cortex is there
    tips = moved[[3, 17, 31]] if named else np.zeros((0, 3))
    seen = Observation(np.concatenate([moved, off]), np.concatenate([rest, off]) if named else None, tips=tips)
    results, given, starts = [], [], []

    def condition(prior, evidence, tips, free):
        given.append((tips, free))
        outliers = np.array([1, *(count + 1 + one for one in lost)])
        results.append(replace(condition_prior(prior, evidence, tips, free), outliers=outliers))
        return results[-1]

    def place(body, observation, near, motion, bias):
        starts.append((near, motion.copy(), bias(rest)))
        return to_deformed_evidence(body, observation, near, motion, bias)

    monkeypatch.setattr(iterated_conditioning, "condition_prior", condition)
    monkeypatch.setattr(iterated_conditioning, "to_deformed_evidence", place)
    found, near = iterated_conditioning.match_and_update(prior, seen, allow_slip=True)
    assert found is results[-1] and 2 <= len(results) <= iterated_conditioning.MAX_ITERATIONS + 1
    np.testing.assert_array_equal(near, np.arange(count))  # without the one that is off the cortex
    every = prior.restrict_shapes(np.arange(len(body.mesh.nodes)))
    for result, (points, motion, bias) in zip(results, starts, strict=False):
        np.testing.assert_array_equal(points, near)
        np.testing.assert_allclose(motion[cortex], np.tensordot(result.shape_weights, every[:, cortex], 1), atol=1e-12)
        assert not np.delete(motion, cortex, axis=0).any()
        np.testing.assert_array_equal(bias, result.compute_bias(rest))
    assert [free for _, free in given] == [True] * len(results)
    kept = np.delete(seen.tips, lost, axis=0).tolist()
    assert [each.tolist() for each, _ in given] == [tips.tolist(), *[kept] * (len(given) - 1)]
