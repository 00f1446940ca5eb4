"""Responses of trained models to tools of the environments, against FEM and Hertz."""

from dataclasses import replace

import numpy as np
import pytest
from gym_examples import SIZE

from scenes.gym.model_responses import Hertz
from scenes.gym.setting import open_setting
from scenes.gym.tasks import DEBULK, PALPATE, RETRACT
from scenes.gym.tissue_requests import TissueRequest
from sim.named_tissues import MATERIALS


def test_model_force_and_motion_match_fem():
    """At a depth of 3 mm: force within 25 %, tumour nodes within a quarter of their motion."""
    site = open_setting(PALPATE, "template", "model", "cpu", SIZE).site
    poses = [PALPATE.tool.pose(site.origin + depth * site.axis, site.axis, site.right) for depth in (-2e-3, 3e-3)]
    found = []
    for physics in ("model", "fem"):
        answers, last = open_setting(PALPATE, "template", physics, "cpu", SIZE).tissue_model, None
        for pose in poses:
            (last,) = answers.compute_responses([TissueRequest(pose, last)])
        assert last is not None and last.reliable
        motion = np.zeros((len(site.anatomy.mesh.nodes), 3))
        motion[last.nodes] = last.motion
        found.append((np.linalg.norm(last.force), motion[site.anatomy.tumour_nodes]))
    (force, motion), (expected, true) = found
    assert abs(force / expected - 1.0) < 0.25 and expected > 0.05
    assert np.linalg.norm(motion - true, axis=1).max() < 0.25 * np.linalg.norm(true, axis=1).max()


def test_batched_model_responses_equal_separate_responses():
    setting = open_setting(PALPATE, "template", "model", "cpu", SIZE)
    site = setting.site
    tips = [site.origin + 1e-3 * depth * site.axis for depth in (-3.0, 0.5, 2.0, 4.0)]
    asked = [TissueRequest(PALPATE.tool.pose(tip, site.axis, site.right)) for tip in tips]
    together = replace(setting.tissue_model, batched=True).compute_responses(asked)
    for one, each in zip(setting.tissue_model.compute_responses(asked), together, strict=True):
        assert np.allclose(one.force, each.force, atol=1e-4) and np.allclose(one.motion, each.motion, atol=1e-5)
    unbound = replace(setting.tissue_model, model=replace(setting.tissue_model.model, bounds=None, bound=7e-4))
    assert unbound.compute_responses(asked[2:3])[0].error == 7e-4  # loads without a bound have the model's


def test_aspirator_force_on_healthy_tissue_follows_hertz(boxed):
    setting = open_setting(DEBULK, boxed, "auto", "cpu", SIZE)
    site, ball = setting.site, Hertz(DEBULK.tool.radius, MATERIALS["drained"].tissue)
    for depth in (1e-3, DEBULK.tool.radius + 1e-3):  # its middle above a flat top, and below it
        tip = site.origin + 0.012 * site.right + depth * site.axis  # beside the corridor
        (touched,) = setting.tissue_model.compute_responses(
            [TissueRequest(DEBULK.tool.pose(tip, site.axis, site.right), completed_steps=1)]
        )
        force = float(ball.compute_force(np.array(depth)))
        assert touched.force @ site.axis == pytest.approx(force, rel=1e-6)
        assert touched.pressure == pytest.approx(1.5 * force / (np.pi * DEBULK.tool.radius * depth))
    assert float(
        ball.compute_extra_depth(np.array(force), ball.compute_contact_radius(np.array(force)))
    ) == pytest.approx(0.0)


def test_pose_outside_the_model_range_ends_the_episode():
    setting = open_setting(RETRACT, "template", "model", "cpu", SIZE)
    site, tool = setting.site, RETRACT.tool
    poses = [tool.pose(site.origin + depth * site.axis, site.axis, site.right) for depth in (2e-3, 40e-3)]
    (first,) = setting.tissue_model.compute_responses([TissueRequest(poses[0])])
    (second,) = setting.tissue_model.compute_responses([TissueRequest(poses[1], first)])
    assert first.reliable and not second.reliable and second.error == np.inf
    assert np.array_equal(second.motion, first.motion)
