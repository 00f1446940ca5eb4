"""Steps per second of Gymnasium environments that are stepped together."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scenes.analysis.measurement import time_work
from scenes.gym.environment import VectorEnv
from scenes.gym.scripted import compute_scripted_actions


@dataclass(frozen=True)
class StepRate:
    """Steps per second of a task, summed over its environments.

    Parameters
    ----------
    task, observation, environments
        Task, type of observation, and number of environments.
    median, least, most
        Median, minimum and maximum over the repeats [1/s].
    touching
        Share of the steps in which a tool exerted a force.
    """

    task: str
    observation: str
    environments: int
    median: float
    least: float
    most: float
    touching: float


def measure_rate(
    environment: VectorEnv, task: str, observation: str, steps: int, repeats: int,
    progress: Callable[[], object] = lambda: None,
) -> StepRate:  # fmt: skip
    """Measure a task under its scripted policy; the first repeat, with compilation and cached solves, does not count.

    Parameters
    ----------
    steps
        Number of steps of every environment in a repeat.
    repeats
        Number of counted repeats.
    progress
        Called after each repeat.
    """
    seen, _ = environment.reset(seed=0)
    rates, touched = [], []
    for _ in range(repeats + 1):
        spent = 0.0
        for _ in range(steps):
            action = compute_scripted_actions(task, seen if isinstance(seen, np.ndarray) else seen["states"])
            (seen, *_, truth), seconds = time_work(environment.step, action)
            spent += seconds
            touched.append(np.linalg.norm(truth["force"], axis=1) > 0.0)
        rates.append(environment.num_envs * steps / spent)
        progress()
    kept = np.array(rates[1:])
    touching = float(np.mean(touched[steps:]))
    return StepRate(
        task, observation, environment.num_envs, float(np.median(kept)), float(kept.min()),
        float(kept.max()), touching,
    )  # fmt: skip
