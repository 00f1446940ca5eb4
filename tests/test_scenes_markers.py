"""`sulcus markers`: written files, and existing files that are kept."""

import json

from PIL import Image

from ar.tracking.pages import describe_targets
from scenes.cli import main


def test_markers_command_writes_and_overwrites_its_files(tmp_path, capsys):
    out = tmp_path / "new" / "markers"
    for words in ([], ["--force"]):
        assert main(["markers", "--out", str(out), *words]) == 0
    assert "measure the rulers" in capsys.readouterr().out
    names = ["board.png", "markers.pdf", "patient.png", "targets.json", "tool.png"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert json.loads((out / "targets.json").read_text()) == describe_targets()
    with Image.open(out / "tool.png") as picture:
        assert picture.size == (4200, 5940)


def test_markers_command_keeps_existing_files_without_force(tmp_path, capsys):
    for name in ("markers.pdf", "tool.png", "targets.json"):
        mine = tmp_path / name
        mine.write_bytes(b"mine")
        assert main(["markers", "--out", str(tmp_path)]) == 2
        assert f"{name}: exists. Give --force" in capsys.readouterr().err
        assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"mine"]
        mine.unlink()
    (tmp_path / "file").write_bytes(b"mine")
    assert main(["markers", "--out", str(tmp_path / "file" / "in")]) == 2
    assert "folder" in capsys.readouterr().err
