"""Scripts: sampled motions of an episode, and the policy of the environments."""

import pytest
from gym_examples import DOWN, made, played
from test_scenes_plan import TINY

from scenes.episodes.make import choose_body
from scenes.episodes.plan import parse_plan
from scenes.episodes.scripted import sample_episode
from scenes.gym.episode import REWARD
from scenes.gym.tasks import PALPATE
from sim.errors import InputError


def test_scripted_policy_reaches_goal_and_pressing_ends_episode():
    rows = played(made(), 3, 60)
    truth = rows[-1][2]
    assert truth["success"] and truth["violations"] == 0 and abs(truth["reached"] / truth["asked"] - 1.0) < 0.15
    assert 0.0 < truth["model_error"] < 0.1e-3 and truth["pressure"] < PALPATE.max_pressure
    environment = made()
    environment.reset(seed=3)
    terminated, rewards = False, []
    while not terminated:
        _, reward, terminated, truncated, truth = environment.step(DOWN)
        assert not truncated
        rewards.append(reward)
    assert truth["load"] > 1.25 and truth["violations"] > 0 and rewards[-1] < REWARD.abort_reward + 1.0
    with pytest.raises(InputError, match=r"call reset\(\)"):
        environment.unwrapped.step(DOWN)


def test_episode_sampling_depends_on_seed_and_name_only():
    plain, more = parse_plan(TINY, "a"), parse_plan(f"{TINY}tool_deg = [0, 1]\n[hand]\ntremor_mm = [0, 1]\n", "b")
    first, again = sample_episode(plain.contents, 4, 7), sample_episode(plain.contents, 4, 7)
    assert first == again and choose_body(plain, 4, 7) == first.body
    other = sample_episode(more.contents, 4, 7)
    same = {name: value for name, value in other.values.items() if name not in ("noise.tool_deg", "hand.tremor_mm")}
    assert same == {name: first.values[name] for name in same}
    assert sample_episode(plain.contents, 4, 8).values != first.values != sample_episode(plain.contents, 5, 7).values
