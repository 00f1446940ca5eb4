"""Observations of the environments: poses, forces and noise."""

import numpy as np
import pytest
from gym_examples import DOWN, made

from scenes.gym.observation import FORCE_NOISE, POSITION_NOISE
from scenes.gym.tasks import PALPATE


def test_observed_states_are_truth_plus_given_noise():
    """In the axes of the actions."""
    environment = made()
    environment.reset(seed=3)
    episode, off = environment.unwrapped.episode, []
    for step in range(60):
        states, _, _, _, truth = environment.step(DOWN if step < 12 else 0.0 * DOWN)
        place = episode.frame.T @ (episode.actual.position - episode.setting.site.origin)
        force = episode.frame.T @ truth["force"]
        off.append((*(1e-2 * states[:3] - place), *(PALPATE.max_force * states[9:12] - force)))
    assert np.linalg.norm(force) > 0.05
    deviation = np.std(off, axis=0)
    assert deviation[:3] == pytest.approx(np.full(3, POSITION_NOISE), rel=0.35)
    assert deviation[3:] == pytest.approx(np.full(3, FORCE_NOISE), rel=0.35)
    assert np.abs(np.mean(off, axis=0)[3:]).max() < FORCE_NOISE
