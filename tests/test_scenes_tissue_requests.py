"""Limits of Gymnasium's tasks: force and pressure."""

from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import scenes.gym  # noqa: F401
from scenes.gym.tasks import PALPATE
from scenes.gym.tissue_requests import Response

DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], np.float32)


@pytest.mark.parametrize(("limit", "share"), [(0.5, "pressure"), (2.0, "force")])
def test_load_is_the_share_of_the_limit_reached_first(limit, share):
    environment = gymnasium.make("sulcus/Palpate-v0", device="cpu", size=(48, 36)).unwrapped
    task = replace(PALPATE, max_pressure=limit * PALPATE.max_pressure)
    environment.episode.setting = replace(environment.episode.setting, task=task)
    environment.reset(seed=3)
    terminated = False
    while not terminated:
        *_, terminated, _, truth = environment.step(DOWN)
    force = np.linalg.norm(truth["force"]) / task.max_force
    shares = {"force": force, "pressure": truth["pressure"] / task.max_pressure}
    assert truth["load"] == pytest.approx(shares[share]) and shares[share] > 1.25 > 1.2 * min(shares.values())


@pytest.mark.parametrize(("shares", "ends"), [("110111", "success"), ("1x", "unreliable"), ("11x", "unreliable")])
def test_episode_ends_after_successive_goals_or_bad_solution(shares, ends):
    """Digits are shares of the goal force; x marks a bad solution."""
    environment = gymnasium.make("sulcus/Palpate-v0", device="cpu", size=(48, 36)).unwrapped
    nodes, seen = np.arange(len(environment.setting.site.anatomy.mesh.nodes)), iter(f"0{shares}")

    def answer(asked):
        share, goal = next(seen), environment.episode.drawn.goal
        force = np.array([0.0, 0.0, goal.amount * (share != "0")])
        return [Response(np.zeros((len(nodes), 3)), nodes, force, 0.0, reliable=share != "x")]

    task = replace(PALPATE, max_distance=1.0, hold_steps=3)
    setting = replace(environment.setting, task=task, tissue_model=SimpleNamespace(compute_responses=answer))
    environment.setting = environment.episode.setting = setting
    environment.reset(seed=3)
    over = [environment.step(0.0 * DOWN) for _ in shares]
    assert [terminated for _, _, terminated, _, _ in over] == [False] * (len(shares) - 1) + [True]
    assert over[-1][-1]["success"] == (ends == "success") != (over[-1][1] < -5.0)
