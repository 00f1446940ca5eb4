"""Three policies press on the cortex over the tumour: random, scripted, and one that is trained here in a minute.

The last is linear in what a robot observes. The cross-entropy method trains it: policies are drawn, the best are kept,
and the next are drawn about these. It needs `pip install "sulcus[gym]"`, and knows nothing of tissue.
"""

import gymnasium
import numpy as np

import scenes.gym  # noqa: F401
from scenes.gym.scripted import scripted

ROUNDS, DRAWN, KEPT, EPISODES, STEPS = 12, 32, 6, 32, 60
vector = gymnasium.make_vec("sulcus/Palpate-v0", num_envs=DRAWN, max_episode_steps=STEPS, device="cpu")


def features(states):
    """Off the place and off the force in three numbers, the force, and 1: what a linear policy needs (n, 5)."""
    off, force = states[:, 13:16] - states[:, 0:3], np.linalg.norm(states[:, 9:12], axis=1)
    near = np.linalg.norm(off[:, :2], axis=1) < 0.15
    return np.column_stack([off[:, :2], near * (states[:, 19] - force), near, np.ones(len(states))])


def linear(weights):
    """Policy of weights (n or 1, 5, 3): actions move, and do not turn."""
    return lambda states: np.pad(np.einsum("nf,nfa->na", features(states), weights), ((0, 0), (0, 3)))


def played(policy, seed):
    """Returns (n,) of one episode in each environment, and in how many steps of it a limit was exceeded."""
    states, _ = vector.reset(seed=seed)
    total, over, live = np.zeros(DRAWN), np.zeros(DRAWN), np.ones(DRAWN, bool)
    while live.any():
        states, reward, ended, cut, truth = vector.step(np.clip(policy(states), -1, 1))
        total += np.where(live, reward, 0.0)
        over = np.where(live, truth["violations"], over)
        live &= ~(ended | cut)
    return total, over


random = np.random.default_rng(0)
mean, deviation = np.zeros((5, 3)), np.full((5, 3), 1.0)
for number in range(ROUNDS):
    weights = mean + deviation * random.standard_normal((DRAWN, 5, 3))
    best = weights[np.argsort(played(linear(weights), [number] * DRAWN)[0])[-KEPT:]]
    mean, deviation = best.mean(axis=0), best.std(axis=0) + 0.3 / (1 + number)

policies = {
    "random": lambda states: random.uniform(-1.0, 1.0, (DRAWN, 6)),
    "scripted": lambda states: scripted("palpate", states),
    "trained": linear(mean[None].repeat(DRAWN, axis=0)),
}
print("policy      return, mean +- standard error   steps over a limit")
found = {}
for name, policy in policies.items():
    total, over = played(policy, 1000)
    found[name] = total.mean()
    print(f"{name:10}  {total.mean():6.2f} +- {total.std(ddof=1) / np.sqrt(DRAWN):.2f}  {over.sum():24.0f}")
assert found["scripted"] > found["trained"] > found["random"] and found["trained"] > 3.0
