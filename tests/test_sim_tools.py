"""Tools: their text, their foremost point, and their surface."""

import numpy as np
import pytest
from test_surrogate_rigid_contact import ROD_OF_4, SMALL_BLADE

from sim.effects import ToolContact
from sim.errors import InputError
from sim.tools import (
    Ball,
    Capsule,
    Core,
    Spatula,
    compute_distances,
    find_foremost_points,
    get_core,
    name_tool,
    parse_tool,
)


def test_tool_repr_round_trip_rejects_other_text() -> None:
    for tool in (Ball(7e-3), ROD_OF_4, SMALL_BLADE):
        assert parse_tool(repr(tool)) == tool
    assert name_tool(ROD_OF_4) == "a rod of 2 mm radius and 20 mm length"
    for text in ("", "Ball", "Ball(7e-3)", "Ball(radius=x)", "Ball(radius=-1.0)", "print(radius=1.0)"):
        with pytest.raises(InputError, match="is no tool"):
            parse_tool(text)
    with pytest.raises(InputError, match="is no tool"):
        parse_tool("(" * 100_000)


def test_foremost_point_is_farthest_on_tool() -> None:
    rng = np.random.default_rng(0)
    for tool in (Ball(7e-3), ROD_OF_4, SMALL_BLADE):
        pose = np.tile(np.eye(4), (5, 1, 1))
        pose[:, :3, :3] = np.linalg.qr(rng.normal(size=(5, 3, 3)))[0]
        pose[:, :3, :3] *= np.linalg.det(pose[:, :3, :3])[:, None, None]
        pose[:, :3, 3] = rng.normal(size=(5, 3))
        way = np.array([0.6, 0.0, -0.8])
        found = find_foremost_points(tool, pose, way)
        core = get_core(tool)
        for row in range(5):
            assert compute_distances(tool, pose[row], found[row][None])[0] == pytest.approx(0.0, abs=1e-9)
            corners = core.corners @ pose[row, :3, :3].T + pose[row, :3, 3]
            assert found[row] @ way == pytest.approx((corners @ way).max() + core.radius)
    flat = find_foremost_points(SMALL_BLADE, np.eye(4)[None], np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(flat, 0.0, atol=1e-12)  # the middle of its face


@pytest.mark.parametrize(
    ("cores", "words"),
    [
        ((), "has no cores: give at least one"),
        ((Core(np.zeros(3), np.zeros(3), 0.0),), "not finite or has no radius"),
        ((Core(np.array([np.nan, 0.0, 0.0]), np.zeros(3), 1e-3),), "not finite or has no radius"),
    ],
)
def test_tool_without_valid_cores_is_rejected(cores: tuple[Core, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        ToolContact((type("Shapeless", (), {"cores": cores})(),))


BLADE = Spatula(0.012, 0.026, 1.5e-3)


@pytest.mark.parametrize(
    ("tool", "ends"),
    [
        (BLADE, [[0.006, 0, 1.5e-3], [0, 0.013, 1.5e-3], [0, 0, 0], [0, 0, 3e-3], [0.004, -0.01, 0]]),
        (Capsule(3e-3, 0.02), [[0, 0, 0], [0, 0, 0.026], [3e-3, 0, 3e-3], [0, -3e-3, 0.02]]),
        (Ball(7e-3), [[0, 0, 0], [0, 0, 0.014], [0, 7e-3, 7e-3]]),
    ],
)
def test_tool_surface_agrees_with_its_sizes(tool, ends):
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0.1, -0.2, 0.3]
    signs = np.array([[x, y, 1.0] for x in (-1, 1) for y in (-1, 1)])
    points = (np.array(ends)[:, None] * signs).reshape(-1, 3)
    assert compute_distances(tool, turn, points @ turn[:3, :3].T + turn[:3, 3]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("tool", "direction", "point"),
    [
        (BLADE, [1e-9, 1.0, 0.0], [0.0, 0.013, 1.5e-3]),  # the middle of an edge
        (BLADE, [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]),  # and of a face
        (BLADE, [0.6, -0.8, 0.0], [0.0045 + 0.6 * 1.5e-3, -0.0115 - 0.8 * 1.5e-3, 1.5e-3]),
        (Capsule(3e-3, 0.02), [1.0, 0.0, 0.0], [3e-3, 0.0, 0.013]),
        (Ball(7e-3), [0.0, 0.0, 1.0], [0.0, 0.0, 0.014]),
    ],
)
def test_foremost_point_lies_on_the_tool_in_the_direction(tool, direction, point):
    assert find_foremost_points(tool, np.eye(4)[None], np.array(direction))[0] == pytest.approx(point, abs=1e-10)
