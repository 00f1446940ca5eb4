"""Images of a report and of a film: the tool at rest on the cortex, and nothing drawn through a drape."""

import numpy as np
import pytest
import trimesh

from scenes.report.worst_case_image import find_rested_tip
from scenes.script.craniotomy_frame import build_craniotomy_frame


def test_report_image_tool_rests_without_piercing(box):
    site, radius = build_craniotomy_frame(box), 5e-3
    nodes = box.mesh.nodes.copy()
    top = site.find_contact(0.0, 0.0, radius).point
    away = np.linalg.norm(nodes - top, axis=1)
    # A dent that is deepest under the tool, and narrower than the ball.
    nodes += 2e-3 * np.exp(-((away / 4e-3) ** 2))[:, None] * site.axis
    middle = find_rested_tip(site, top, nodes, radius) - radius * site.axis
    surface = trimesh.Trimesh(nodes, box.open_surface, process=False)
    assert trimesh.proximity.closest_point_naive(surface, middle[None])[1][0] == pytest.approx(radius, abs=1e-8)
