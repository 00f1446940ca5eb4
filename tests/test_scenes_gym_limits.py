"""Limits of Gymnasium's tasks: of force and pressure, and of where a tool may go."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

import scenes.gym  # noqa: F401
from scenes.gym.tasks import PALPATE
from scenes.gym.tool_motion import HIGHEST, laid, moved
from scenes.script.site import site_of

DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], np.float32)


@pytest.mark.parametrize(("limit", "share"), [(0.5, "pressure"), (2.0, "force")])
def test_load_is_the_share_of_the_limit_reached_first(limit, share):
    environment = gymnasium.make("sulcus/Palpate-v0", device="cpu", size=(48, 36)).unwrapped
    task = replace(PALPATE, pressure=limit * PALPATE.pressure)
    environment.episode.setting = replace(environment.episode.setting, task=task)
    environment.reset(seed=3)
    terminated = False
    while not terminated:
        *_, terminated, _, truth = environment.step(DOWN)
    shares = {"force": np.linalg.norm(truth["force"]) / task.force, "pressure": truth["pressure"] / task.pressure}
    assert truth["load"] == pytest.approx(shares[share]) and shares[share] > 1.25 > 1.2 * min(shares.values())


def test_tool_leans_and_sinks_no_farther_than_it_may(box):
    site, tool = site_of(box), PALPATE.tool
    hand = laid(site, tool, site.origin)
    for angle, turned in ((0.29, True), (0.31, False)):
        found = moved(hand, site, tool, np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0]), 0.3, 5e-3)
        assert (np.abs(found.turned - hand.turned).max() > 0.1) == turned
    for way, depth in ((-1.0, 5e-3), (1.0, -HIGHEST)):
        found = moved(hand, site, tool, np.array([0.0, 0.0, way, 0.0, 0.0, 0.0]), 0.3, 5e-3)
        assert (found.place - site.origin) @ site.axis == pytest.approx(depth - tool.radius)
