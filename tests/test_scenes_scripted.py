"""The scripted policy of the environments."""

import pytest
from gym_examples import DOWN, made, played

from scenes.gym.episode import ENDED
from scenes.gym.tasks import PALPATE
from sim.errors import InputError


def test_the_scripted_policy_palpates_and_pushing_on_ends_at_the_limit():
    rows = played(made(), 3, 60)
    truth = rows[-1][2]
    assert truth["success"] and truth["violations"] == 0 and abs(truth["reached"] / truth["asked"] - 1.0) < 0.15
    assert 0.0 < truth["model_error"] < 0.1e-3 and truth["pressure"] < PALPATE.pressure
    environment = made()
    environment.reset(seed=3)
    terminated, rewards = False, []
    while not terminated:
        _, reward, terminated, truncated, truth = environment.step(DOWN)
        assert not truncated
        rewards.append(reward)
    assert truth["load"] > 1.25 and truth["violations"] > 0 and rewards[-1] < ENDED + 1.0
    with pytest.raises(InputError, match=r"call reset\(\)"):
        environment.unwrapped.step(DOWN)
