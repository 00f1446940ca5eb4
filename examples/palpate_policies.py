"""Three policies press on the cortex over the tumour: random, scripted, and one that is trained here in seconds.

The trained one is linear in what a robot observes, and has four weights. The cross-entropy method finds them: policies
are drawn, the best are kept, and the next are drawn about those. It needs `pip install -e '.[gym]'`.
"""

import gymnasium
import numpy as np

import scenes.gym  # registers the environments
from scenes.gym.scripted import compute_scripted_actions

ROUNDS, DRAWN, KEPT, STEPS = 7, 32, 5, 40
scenes.gym.register_environments()
# Together: faster on the CPU, where rows answered apart would have the same bytes wherever they stand.
make = {"num_envs": DRAWN, "max_episode_steps": STEPS, "device": "cpu", "together": True}
vector = gymnasium.make_vec("sulcus/Palpate-v0", **make)


def linear(weights):
    """Policy of weights (n, 4): aside to the place; down by the missing force where it is near, by some, and always."""

    def act(states):
        off = states[:, 13:15] - states[:, 0:2]
        near = np.linalg.norm(off, axis=1) < 0.2
        missing = near * (states[:, 19] - np.linalg.norm(states[:, 9:12], axis=1))
        down = weights[:, 1] * missing + weights[:, 2] * near + weights[:, 3]
        return np.column_stack([weights[:, :1] * off, -down, np.zeros((len(off), 3))])

    return act


def played(policy, seed):
    """Play one episode per environment; return returns (n,) and the number of steps beyond a limit (n,)."""
    states, _ = vector.reset(seed=seed)
    total, over, live = np.zeros(DRAWN), np.zeros(DRAWN), np.ones(DRAWN, bool)
    while live.any():
        states, reward, ended, late, truth = vector.step(np.clip(policy(states), -1, 1))
        total, over = total + live * reward, np.where(live, truth["violations"], over)
        live &= ~(ended | late)
    return total, over


random = np.random.default_rng(0)
mean, deviation = np.zeros(4), np.full(4, 4.0)
for number in range(ROUNDS):
    weights = mean + deviation * random.standard_normal((DRAWN, 4))
    best = weights[np.argsort(played(linear(weights), [number] * DRAWN)[0])[-KEPT:]]
    mean, deviation = best.mean(axis=0), best.std(axis=0) + 1.0 / (1 + number)

policies = {"random": lambda states: random.uniform(-1, 1, (DRAWN, 6))}
policies["scripted"] = lambda states: compute_scripted_actions("palpate", states)
policies["trained"] = linear(np.tile(mean, (DRAWN, 1)))
found = {name: played(policy, 1000) for name, policy in policies.items()}
print("policy      mean return +- standard error    steps over a limit in 100 episodes")
for name, (total, over) in found.items():
    error = total.std(ddof=1) / np.sqrt(DRAWN)
    print(f"{name:10}  {total.mean():11.2f} +- {error:.2f} {100 * over.mean():37.0f}")
assert found["scripted"][0].mean() > found["random"][0].mean() + 5 and found["trained"][0].mean() > 5
