"""Columns of exports: twists, frame rates and held-out bodies."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes import read_episodes
from scenes.episodes.exports.columns import build_states, build_twists, compute_frame_rate, mark_held_out
from scenes.episodes.reading.contents import read_contents
from sim.errors import InputError


def poses_after(first, steps):
    """Poses (T, 4, 4) from the first (4, 4) on, by twists (T, 6)."""
    found = [np.asarray(first, np.float64)]
    for step in np.asarray(steps, np.float64)[:-1]:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ found[-1][:3, :3]
        pose[:3, 3] = found[-1][:3, 3] + step[:3]
        found.append(pose)
    return np.stack(found)


def test_twists_transform_each_pose_into_the_next(folder):
    tool = read_episodes(folder, ["T_world_tool"], window=9).get_window(1, 0)["T_world_tool"]
    steps = build_twists(tool)
    assert np.allclose(poses_after(tool[0], steps), tool, atol=1e-6) and not steps[-1].any() and steps[:-1].any()
    state = build_states(tool)
    assert np.allclose(state[:, :3], tool[:, :3, 3]) and np.allclose(np.linalg.norm(state[:, 3:], axis=1), 1.0)
    turning = np.tile(np.eye(4), (9, 1, 1))
    for number, angle in enumerate(np.linspace(0.0, 4 * np.pi, 9)):
        turning[number, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    around = build_states(turning)[:, 3:]
    assert (np.einsum("ij,ij->i", around[1:], around[:-1]) > -1e-6).all()


@pytest.mark.parametrize("off", [2e-3, 2e-4, 5e-5])
def test_frame_rate_requires_even_steps_within_100_us(off, tmp_path):
    contents, time = SimpleNamespace(path=tmp_path / "e.h5"), 0.04 * np.arange(26)
    time[10] += off
    if off < 1e-4:
        assert compute_frame_rate(contents, time) == 25.0
        return
    with pytest.raises(InputError, match="not evenly spaced"):
        compute_frame_rate(contents, time)


def test_each_tenth_body_is_held_out(folder):
    contents = read_contents(folder / "episode_000000.h5")
    assert mark_held_out([contents]) == [False] and mark_held_out([contents] * 3) == [False, False, True]
    assert [number for number, out in enumerate(mark_held_out([contents] * 25)) if out] == [9, 19]
