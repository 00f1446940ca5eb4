"""Points of a frame that no other point supports."""

from dataclasses import replace

import numpy as np
import pytest
from locators import dent, locator_of
from test_surrogate_fit import build_tool_frame

from sim.errors import InputError
from surrogate.fitting import fit
from surrogate.fitting.frame_likelihood import find_unsupported_points


@pytest.fixture(scope="module")
def locator(body):
    return locator_of(body)


def test_unsupported_points_are_excluded_from_the_fit(body, locator, monkeypatch):
    """Same points as excluded by `locate`; a frame with more than a third of them is rejected."""
    clean = build_tool_frame(body, dent(body, np.random.default_rng(1)))
    clean = replace(clean, observation=replace(clean.observation, sigma=np.full(60, 3e-4)))
    wild = np.where(np.isin(np.arange(60), (5, 17))[:, None], [0.0, 0.01, -0.012], 0.0)
    frames = [clean, replace(clean, observation=replace(clean.observation, now=clean.observation.now + wild))]
    left_out = find_unsupported_points(locator, frames)
    assert [each.tolist() for each in left_out] == [[], [5, 17]]
    fitted_to = []
    monkeypatch.setattr(fit, "solve_responses", lambda *_: None)
    monkeypatch.setattr(fit, "fit_tissue_from_responses", lambda locator, frames, *_: fitted_to.extend(frames))
    fit.fit_tissue(locator, frames)
    assert fitted_to[0] is clean and np.array_equal(
        fitted_to[1].observation.rest, np.delete(clean.observation.rest, (5, 17), axis=0)
    )
    assert len(fitted_to[1].observation.now) == len(fitted_to[1].observation.sigma) == 58
    torn = replace(clean.observation, now=clean.observation.now + np.where(np.arange(60)[:, None] % 2, 0.012, 0.0))
    with pytest.raises(InputError, match=r"frame 2: .* of 60 points"):
        find_unsupported_points(locator, [clean, replace(clean, observation=torn)])
