"""Files of tracked tools."""

import json

import numpy as np
import pytest

from scenes.tracked.tracked_tool import TrackedTool, read_tool, write_tool
from sim.errors import InputError
from sim.tools import Ball, Capsule, Spatula


@pytest.mark.parametrize("shape", [Ball(7e-3), Capsule(3e-3, 20e-3), Spatula(12e-3, 26e-3, 1.5e-3)])
def test_tool_file_round_trips_and_mesh_encloses_its_shape(shape, tmp_path):
    tool = TrackedTool(shape, tip_covariance=np.diag([1e-8, 2e-8, 3e-8]))
    write_tool(tmp_path / "tool.json", tool)
    again = read_tool(tmp_path / "tool.json")
    assert again.shape == shape
    np.testing.assert_allclose(again.T_cube_tool, tool.T_cube_tool)
    np.testing.assert_allclose(again.tip_covariance, tool.tip_covariance)
    vertices, triangles = again.mesh
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-4) and triangles.max() < len(vertices)
    assert vertices[:, 2].max() == pytest.approx(0.15 + 24e-3)  # the cube's upper face


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("format", "sulcus tool 9", "its format is not"),
        ("shape", "Spoon()", "is no tool"),
        ("T_cube_tool", (2.0 * np.eye(4)).tolist(), "no rigid transform"),
        ("T_cube_tool", [[1, 0, 0, 5000], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "give millimetres"),
        ("tip_covariance_mm2", [[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "no covariance"),
    ],
)
def test_damaged_tool_file_is_rejected(name, value, said, tmp_path):
    path = tmp_path / "tool.json"
    write_tool(path, TrackedTool(Ball(7e-3)))
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}))
    with pytest.raises(InputError, match=said):
        read_tool(path)
