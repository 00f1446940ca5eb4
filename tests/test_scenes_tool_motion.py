"""Tool motion that an action requests."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from theatres import template_theatre

import scenes.gym  # noqa: F401
from scenes.gym.tasks import PALPATE
from scenes.gym.tool_motion import MAX_HEIGHT, move_tool, place_tool
from scenes.script.craniotomy_frame import build_craniotomy_frame


def test_tool_tilt_and_depth_are_limited(box):
    site, tool = build_craniotomy_frame(box), PALPATE.tool
    hand = place_tool(site, tool, site.origin)
    for angle, turned in ((0.29, True), (0.31, False)):
        found = move_tool(hand, site, tool, np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0]), 0.3, 5e-3)
        assert (np.abs(found.rotation - hand.rotation).max() > 0.1) == turned
    for way, depth in ((-1.0, 5e-3), (1.0, -MAX_HEIGHT)):
        found = move_tool(hand, site, tool, np.array([0.0, 0.0, way, 0.0, 0.0, 0.0]), 0.3, 5e-3)
        assert (found.position - site.origin) @ site.axis == pytest.approx(depth - tool.radius)


def test_tool_turns_about_the_axes_of_the_open_cortex():
    site, tool = template_theatre().site, PALPATE.tool
    hand = place_tool(site, tool, site.origin)
    for number, axis in enumerate((site.right, site.up, -site.axis)):
        twist = 0.2 * np.eye(6)[3 + number]
        found = move_tool(hand, site, tool, twist, 0.3, 5e-3)
        turned = Rotation.from_rotvec(0.2 * axis).as_matrix() @ hand.rotation
        np.testing.assert_allclose(found.rotation, turned, atol=1e-9)
