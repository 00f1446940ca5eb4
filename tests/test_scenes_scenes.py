"""Command that lists scenes: deformers, thumbnails and a sheet."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from theatres import PUSHING, short

from scenes.cli import main
from scenes.play.scene_costs import render_thumbnail
from scenes.script.scene import SCENES, find_scene
from sim.effects import ToolForce


@pytest.fixture(scope="module")
def anatomy(box_folder):
    return str(box_folder / "box.vtu")


class TestScenes:
    def test_scenes_command_lists_scenes_with_deformers(self, anatomy, capsys):
        assert main(["scenes", "--anatomy", anatomy, "--device", "cpu", "--json"]) == 0
        reported = {row["scene"]: row for row in json.loads(capsys.readouterr().out)["scenes"]}
        assert tuple(reported) == SCENES
        for name, row in reported.items():
            assert row["deformers"] == (["linear", "svr", "guarded", "fem"] if name in PUSHING else ["fem"])
            assert ("ToolForce" in row["effects"]) == (ToolForce() in find_scene(name).effects)
        assert "Resection" in reported["resection"]["effects"] and "milliseconds" not in reported["press"]

    def test_scenes_command_writes_thumbnails_and_sheet(self, anatomy, tmp_path, capsys):
        out = tmp_path / "new" / "sheet"
        assert main(["scenes", "press", "brain_shift", "--anatomy", anatomy, "--device", "cpu", "--out", str(out)]) == 0
        assert "ms a frame by guarded; the tumour moves" in capsys.readouterr().out
        assert sorted(path.name for path in out.iterdir()) == ["brain_shift.png", "press.png", "sheet.png"]
        whole, one = (cv2.imread(str(out / name)) for name in ("sheet.png", "press.png"))
        assert one.shape == (360, 480, 3) and whole.shape == (360, 1440, 3)
        assert np.array_equal(whole[:, :480], one) and (whole[:, 960:] == 12).all()

    def test_scene_name_does_not_cover_text_at_the_bottom(self, theatre):
        scene = short()
        wide = replace(scene, viewpoint=replace(scene.viewpoint, width=480, height=360))
        player = theatre.build_player("linear", wide)
        foot, kept = render_thumbnail(player, "linear").image[-40:], []
        for frame in player.play_frames():
            words = frame.taken[-40:] > 0
            kept.append(words.any() and np.array_equal(foot[words], frame.shown[-40:][words]))
        assert any(kept)

    def test_scenes_command_rejects_file_as_output_folder(self, anatomy, tmp_path, capsys):
        (tmp_path / "file").touch()
        assert main(["scenes", "--anatomy", anatomy, "--out", str(tmp_path / "file")]) == 2
        assert "need a folder" in capsys.readouterr().err
