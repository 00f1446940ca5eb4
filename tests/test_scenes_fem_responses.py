"""FEM responses to tools and cuts of the environments."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from gym_examples import made, many, played

import scenes.gym  # noqa: F401
from scenes.gym.fem_responses import ResectionFem
from scenes.gym.scripted import compute_scripted_actions
from scenes.gym.setting import open_setting
from scenes.gym.tasks import DEBULK
from scenes.gym.tissue_requests import TissueRequest
from sim.bodies.meshfile import write_anatomy
from sim.deformation import Outcome


def test_cut_body_is_reliable_if_both_fluid_levels_converge(box, tmp_path):
    """Fluid level halfway between two solved levels; the lower one has no equilibrium."""
    write_anatomy(tmp_path / "box.vtu", box)
    setting, solved = open_setting(DEBULK, str(tmp_path / "box.vtu"), "auto", "cpu", (48, 36)), []

    def deform(loads, start):
        answer = setting.tissue_model.fem.deform(loads, start)
        solved.append(answer if not solved else replace(answer, outcome=(Outcome.BUDGET,)))
        return solved[-1]

    fem = SimpleNamespace(deform=deform, get_remaining_body=setting.tissue_model.fem.get_remaining_body)
    pose = DEBULK.tool.pose(setting.site.origin, setting.site.axis, setting.site.right)
    for fluid, good in ((1.0, True), (0.95, False)):
        answers = ResectionFem(setting.site, fem, setting.tissue_model.ball)
        assert answers.compute_responses([TissueRequest(pose, fluid=fluid, completed_steps=1)])[0].reliable == good
        solved.clear()


def test_batched_fem_responses_equal_separate_responses(boxed):
    """Spatulas on a box with different paths; the second environment is reset in between."""
    vectors = [many(2, "Retract", anatomy=boxed, together=each) for each in (False, True)]
    seen = [vector.reset(seed=[0, 1]) for vector in vectors]
    touched = np.zeros(2, bool)
    for number in range(14):
        if number == 12:
            for vector in vectors:
                vector.episodes[1].over = True
        actions = compute_scripted_actions("retract", seen[0][0])
        seen = [vector.step(actions) for vector in vectors]
        apart, together = (each[-1] for each in seen)
        assert np.allclose(apart["force"], together["force"], atol=2e-3)
        assert np.allclose(apart["tumour_nodes"], together["tumour_nodes"], atol=5e-5)
        assert np.allclose(apart["pressure"], together["pressure"], rtol=0.05, atol=50.0)
        touched |= apart["pressure"] > 0.0
    assert touched.any()


def test_debulk_removes_the_tumour_in_steps(boxed):
    rows = played(made("Debulk", anatomy=boxed), 0, 120, "debulk")
    truths = [truth for _, _, truth in rows]
    assert truths[-1]["success"] and truths[-1]["reached"] == 3.0 and truths[-1]["violations"] == 0
    assert sorted({truth["steps_done"] for truth in truths}) == [1, 2, 3]
    sunk = np.linalg.norm(truths[-1]["tumour_nodes"] - truths[0]["tumour_nodes"], axis=1)
    assert sunk.mean() > 1e-5
