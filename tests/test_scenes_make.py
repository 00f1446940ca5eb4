"""Making of one body of a data set."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_scenes_run_folder import PLAN, fails

from scenes.episodes.make import add_noise, add_sensor_noise, make_body, to_body_path
from scenes.episodes.plan import load_plan
from sim.bodies.meshfile import write_anatomy
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically


@pytest.fixture
def plan(box, tmp_path):
    write_anatomy(tmp_path / "box.vtu", box)
    (tmp_path / "own.toml").write_text(PLAN)
    return load_plan(str(tmp_path / "own.toml"))


def test_failed_rename_leaves_no_files(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(InputError, match=r"bodies/0000: cannot be written \(Operation not permitted\). Choose another"):
        make_body(tmp_path / "set", plan, 1, 0, "cpu")
    monkeypatch.setattr(Path, "replace", fails)
    with (
        pytest.raises(InputError, match=r"one.h5: cannot be written"),
        write_atomically(tmp_path / "one.h5", ".h5") as part,
    ):
        part.touch()
    assert not [left for left in tmp_path.rglob("*") if left.name.startswith(".sulcus")]
    assert not to_body_path(tmp_path / "set", 0).exists()


def test_incomplete_body_folder_is_reported(plan, tmp_path):
    to_body_path(tmp_path, 0).mkdir(parents=True)
    assert "bodies/0000: is no whole body. Remove it" in make_body(tmp_path, plan, 1, 0, "cpu").failed


def test_image_noise_has_given_deviation_and_zero_mean():
    """At medium grey, up to the largest deviation of a plan."""
    grey = np.full((200, 200, 3), 128, np.uint8)
    for deviation in (1.0, 6.0, 40.0):
        added = add_noise(grey, deviation, np.random.default_rng(3)).astype(float) - 128.0
        assert added.std() == pytest.approx(deviation, rel=0.06)
        assert abs(added.mean()) < 0.02 * deviation
    dark = add_noise(np.zeros_like(grey), 40.0, np.random.default_rng(3))
    assert np.mean(dark == 0) == pytest.approx(0.5, abs=0.02)


def test_sensed_poses_have_the_given_rotation_and_shift_error():
    true = np.eye(4)
    true[:3, :3], true[:3, 3] = Rotation.from_rotvec([1.0, -0.5, 0.3]).as_matrix(), (0.4, -0.2, 0.3)
    columns = {name: np.tile(true, (4000, 1, 1)) for name in ("T_world_tool", "T_camera_world")}
    noise = {"tool_mm": 0.5, "tool_deg": 0.3, "camera_mm": 2.0, "camera_deg": 1.5}
    found = add_sensor_noise(columns | {"force": np.zeros((4000, 3))}, noise | {"force_n": 0.02}, 0, 0)
    for name, whose in (("T_world_tool_tracked", "tool"), ("T_camera_world_tracked", "camera")):
        off = np.linalg.inv(true) @ found[name]  # along and about its own axes
        turns = np.degrees(Rotation.from_matrix(off[:, :3, :3]).as_rotvec())
        assert turns.std(axis=0) == pytest.approx(noise[f"{whose}_deg"], rel=0.05)
        assert 1e3 * off[:, :3, 3].std(axis=0) == pytest.approx(noise[f"{whose}_mm"], rel=0.05)
    assert found["force_read"].std(axis=0) == pytest.approx(0.02, rel=0.05)
