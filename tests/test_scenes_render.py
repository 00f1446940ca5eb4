"""Command that renders frames: existing frames are kept, or removed by force."""

from ar.screen import read_png
from scenes.cli import main


def test_render_keeps_existing_frames_unless_forced(box_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(box_folder)
    words = ["render", "press", "--anatomy", "box.vtu", "--device", "cpu", "--out", str(tmp_path), "--plain"]
    assert main([*words, "--every", "60", "--film", str(tmp_path / "press.gif")]) == 0
    assert f"video {tmp_path / 'press.gif'}" in capsys.readouterr().out
    first = {path: path.read_bytes() for path in tmp_path.glob("frame_*.png")}
    assert len(first) == 3
    assert all(read_png(path).shape == (600, 800, 3) for path in first)
    (tmp_path / "frame_mine.png").write_bytes(b"mine")
    assert main([*words, "--every", "120"]) == 2
    assert "holds 3 frames. Give --force" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in first} == first
    assert main([*words, "--every", "120", "--force"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "frame_0000.png", "frame_0120.png", "frame_mine.png", "press.gif",
    ]  # fmt: skip
