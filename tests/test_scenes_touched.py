"""Limits of Gymnasium's tasks: of force and of pressure."""

from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import scenes.gym  # noqa: F401
from scenes.gym.cut_elements import CutElements
from scenes.gym.setting import open_setting
from scenes.gym.tasks import DEBULK, PALPATE
from scenes.gym.touched import Asked, Touched
from sim.bodies.meshfile import write_anatomy
from sim.deformation import Outcome

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


@pytest.mark.parametrize(("shares", "ends"), [("110111", "success"), ("1x", "unreliable"), ("11x", "unreliable")])
def test_episode_is_over_after_goals_in_a_row_or_a_bad_answer(shares, ends):
    """Shares of the force that is asked for; x: of a solution that is not good."""
    environment = gymnasium.make("sulcus/Palpate-v0", device="cpu", size=(48, 36)).unwrapped
    nodes, seen = np.arange(len(environment.setting.site.anatomy.mesh.nodes)), iter(f"0{shares}")

    def answer(asked):
        share, goal = next(seen), environment.episode.drawn.goal
        force = np.array([0.0, 0.0, goal.amount * (share != "0")])
        return [Touched(np.zeros((len(nodes), 3)), nodes, force, 0.0, good=share != "x")]

    task = replace(PALPATE, aside=1.0, held=3)
    setting = replace(environment.setting, task=task, answers=SimpleNamespace(answer=answer))
    environment.setting = environment.episode.setting = setting
    environment.reset(seed=3)
    over = [environment.step(0.0 * DOWN) for _ in shares]
    assert [terminated for _, _, terminated, _, _ in over] == [False] * (len(shares) - 1) + [True]
    assert over[-1][-1]["success"] == (ends == "success") != (over[-1][1] < -5.0)


def test_cut_elements_are_reliable_where_both_levels_are(box, tmp_path):
    """Half way between two levels of the fluid, of which the lower one finds no equilibrium."""
    write_anatomy(tmp_path / "box.vtu", box)
    setting, solved = open_setting(DEBULK, str(tmp_path / "box.vtu"), "auto", "cpu", (48, 36)), []

    def deform(loads, start):
        answer = setting.answers.fem.deform(loads, start)
        solved.append(answer if not solved else replace(answer, outcome=(Outcome.BUDGET,)))
        return solved[-1]

    fem = SimpleNamespace(deform=deform, remains=setting.answers.fem.remains)
    pose = DEBULK.tool.pose(setting.site.origin, setting.site.axis, setting.site.right)
    for fluid, good in ((1.0, True), (0.95, False)):
        answers = CutElements(setting.site, fem, setting.answers.ball)
        assert answers.answer([Asked(pose, fluid=fluid, done=1)])[0].good == good
        solved.clear()
