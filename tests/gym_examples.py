"""Environments of a small picture, and episodes of the scripted policy in them."""

import gymnasium
import numpy as np

from scenes.gym.scripted import compute_scripted_actions

SIZE = (48, 36)
DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], np.float32)


def made(name="Palpate", **given):
    return gymnasium.make(f"sulcus/{name}-v0", device="cpu", size=SIZE, **given)


def many(count, name="Palpate", **given):
    return gymnasium.make_vec(f"sulcus/{name}-v0", num_envs=count, device="cpu", size=SIZE, **given)


def played(environment, seed, steps, task="palpate"):
    """Observations, rewards and truth of the scripted policy, until the episode is over."""
    seen, truth = environment.reset(seed=seed)
    rows = [(seen, 0.0, truth)]
    for _ in range(steps):
        states = seen["states"] if isinstance(seen, dict) else seen
        seen, reward, terminated, truncated, truth = environment.step(compute_scripted_actions(task, states))
        rows.append((seen, reward, truth))
        if terminated or truncated:
            break
    return rows
