"""The making of one body of a data set."""

from pathlib import Path

import pytest
from test_scenes_run_folder import PLAN, fails

from scenes.episodes.make import body_path, make_body
from scenes.episodes.plan import load_plan
from sim.bodies.meshfile import write_anatomy
from sim.errors import InputError
from sim.runtime.atomic_files import written_whole


@pytest.fixture
def plan(box, tmp_path):
    write_anatomy(tmp_path / "box.vtu", box)
    (tmp_path / "own.toml").write_text(PLAN)
    return load_plan(str(tmp_path / "own.toml"))


def test_where_nothing_can_be_renamed_nothing_is_left(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(InputError, match=r"bodies/0000: cannot be written \(Operation not permitted\). Choose another"):
        make_body(tmp_path / "set", plan, 1, 0, "cpu")
    monkeypatch.setattr(Path, "replace", fails)
    with (
        pytest.raises(InputError, match=r"one.h5: cannot be written"),
        written_whole(tmp_path / "one.h5", ".h5") as part,
    ):
        part.touch()
    assert not [left for left in tmp_path.rglob("*") if left.name.startswith(".sulcus")]
    assert not body_path(tmp_path / "set", 0).exists()


def test_a_body_that_is_not_whole_is_named(plan, tmp_path):
    body_path(tmp_path, 0).mkdir(parents=True)
    assert "bodies/0000: is no whole body. Remove it" in make_body(tmp_path, plan, 1, 0, "cpu").failed
