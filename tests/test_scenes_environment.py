"""Surgical tasks as Gymnasium environments: single, vectorised, and rejected input."""

import numpy as np
import pytest
from gym_examples import DOWN, SIZE, made, many, played
from gymnasium import make_vec
from gymnasium.utils.env_checker import check_env

from scenes.gym.scripted import compute_scripted_actions
from sim.errors import InputError


@pytest.mark.parametrize("observation", ["states", "rgbd"])
def test_gymnasium_checker_accepts_all_environments(observation, boxed):
    for name, given in (("Palpate", {}), ("Retract", {"anatomy": boxed}), ("Debulk", {"anatomy": boxed})):
        environment = made(name, observation=observation, render_mode="rgb_array", **given)
        check_env(environment.unwrapped)
        assert environment.action_space.shape == (6,)


def test_same_seed_and_actions_give_same_bytes():
    """Single, and second of three with other actions; images too."""
    alone = played(made(observation="rgbd"), 7, 18)
    vector = many(3, observation="rgbd")
    seen, _ = vector.reset(seed=[0, 7, 3])
    for row, (expected, _, _) in enumerate(alone[1:]):
        actions = np.stack([DOWN, compute_scripted_actions("palpate", seen["states"][1]), 0.0 * DOWN])
        seen, _, _, _, truth = vector.step(actions)
        for key in ("rgb", "depth", "states"):
            assert seen[key][1].tobytes() == expected[key].tobytes(), row
    assert truth["tumour_nodes"][1].tobytes() == alone[-1][2]["tumour_nodes"].tobytes()
    assert np.linalg.norm(truth["force"][1]) > 0.01  # the tool touches by now


def test_vector_environment_resets_finished_episodes():
    vector = many(2, max_episode_steps=3)
    first, _ = vector.reset(seed=5)
    for _ in range(2):
        assert not vector.step(np.zeros((2, 6)))[3].any()
    assert vector.step(np.zeros((2, 6)))[3].all()
    seen, rewards, _, truncated, _ = vector.step(np.zeros((2, 6)))
    assert not truncated.any() and not rewards.any() and seen[0, 12] == 0.0
    assert not np.allclose(seen, first)  # another goal
    # As one environment draws its second episode.
    one = made()
    one.reset(seed=5)
    for _ in range(3):
        one.step(np.zeros(6, np.float32))
    assert np.array_equal(one.reset()[0], seen[0])


def test_vector_environment_equals_gymnasium_sync_vector():
    """Byte for byte, across the end of episodes; ground truth too."""
    vectors = [many(2, max_episode_steps=4), many(2, max_episode_steps=4, vectorization_mode="sync")]
    assert vectors[0].metadata["autoreset_mode"] == vectors[1].metadata["autoreset_mode"]
    random = np.random.default_rng(0)
    ours, theirs = (vector.reset(seed=11) for vector in vectors)
    for _ in range(12):
        for one, other in zip(ours[:-1], theirs[:-1], strict=True):
            assert np.array_equal(one, other)
        assert set(theirs[-1]) <= set(ours[-1])
        assert all(np.array_equal(ours[-1][name], value) for name, value in theirs[-1].items())
        actions = random.uniform(-1.0, 1.0, (2, 6)).astype(np.float32)
        ours, theirs = (vector.step(actions) for vector in vectors)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"observation": "sounds"}, "choose one of states, rgbd"),
        ({"physics": "magic"}, "choose one of auto, model, fem"),
        ({"size": (3, 4000)}, "from 16 to 4096"),
        ({"render_mode": "human"}, "choose rgb_array"),
        ({"anatomy": 3}, "path of a .vtu file"),
        ({"anatomy": "nowhere.vtu"}, "nowhere.vtu"),
        ({"task": "juggle"}, "choose one of palpate, retract, debulk"),
        ({"task": "debulk", "physics": "model"}, "Give physics='fem'"),
        ({"model": 3}, "path of a .model.npz file"),
        ({"task": "retract", "model": "nowhere.npz"}, "nowhere.npz"),
    ],
)
def test_environment_rejects_invalid_options(given, said):
    from scenes.gym.environment import SurgeryEnv

    with pytest.raises(InputError, match=said.replace("(", r"\(")):
        SurgeryEnv(**({"device": "cpu", "size": SIZE} | given))


def test_environment_rejects_invalid_actions_and_reset_options():
    environment, vector = made().unwrapped, many(2)
    with pytest.raises(InputError, match=r"call reset\(\)"):
        environment.step(DOWN)
    with pytest.raises(InputError, match="there are none"):
        environment.reset(options={"goal": 1})
    environment.reset(seed=0)
    for action in (np.full(6, np.nan), np.zeros(5), np.array([np.inf] * 6)):
        with pytest.raises(InputError, match="six finite numbers"):
            environment.step(action)
    with pytest.raises(InputError, match="give one for each"):
        vector.reset(seed=[1])
    with pytest.raises(InputError, match=r"\(2, 6\)"):
        vector.step(np.zeros((3, 6)))
    with pytest.raises(InputError, match="no task"):
        compute_scripted_actions("juggle", np.zeros(24))


def test_spatula_model_gives_same_bytes_alone_and_in_vector():
    """Byte for byte, during contact; and in a separate process."""
    alone = played(made("Retract"), 2, 16, "retract")
    vector = many(2, "Retract")
    seen, _ = vector.reset(seed=[5, 2])
    true = alone[-1][2]
    for expected, _, _ in alone[1:]:
        seen, _, _, _, truth = vector.step(compute_scripted_actions("retract", seen))
        assert seen[1].tobytes() == expected.tobytes()
    assert truth["reliable"].all() and truth["force"][1].tobytes() == true["force"].tobytes()
    assert np.linalg.norm(true["force"]) > 0.02 and 0.0 < true["model_error"] < 1e-3 and 0.0 < true["pressure"] < 4e3
    process = {"vectorization_mode": "async", "vector_kwargs": {"context": "spawn"}}
    apart = make_vec("sulcus/Retract-v0", 1, **process, device="cpu", size=SIZE)
    assert apart.reset(seed=2)[0][0].tobytes() == alone[0][0].tobytes()
    apart.close()
