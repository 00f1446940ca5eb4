"""Output paths of commands: checked before the work, and existing files are kept."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from boxes import base_held, top_forces
from boxes import box as cube
from programs import main

from scenes.options.outputs import (
    check_no_foreign_files,
    check_output_frames,
    check_output_path,
    find_foreign_files,
    remove_outdated_data,
)
from sim.bodies.intensity import to_intensity_path
from sim.bodies.meshfile import read_mesh, write_mesh
from sim.errors import InputError
from sim.runtime.atomic_files import check_output
from sim.runtime.journal import open_journal

# None of what they read is there: whoever looks at it first says so, and not that nothing can be written.
WRITING = {
    "anatomy": (["anatomy", "--labels", "none.nii.gz", "--brain", "1", "--tumour", "2"], "x.vtu"),
    "solve": (["solve", "none.vtu"], "x.vtu"),
    "simulate": (["simulate", "none.vtu"], "x.h5"),
    "train": (["train", "none.h5"], "x.npz"),
    "export": (["export", "none.npz"], "x.onnx"),
    "patient": (["patient", "none.nii.gz", "--brain", "1", "--tumour", "2"], "x.vtu"),
    "collect": (["collect", "press", "--anatomy", "none.vtu"], "x.h5"),
    "sensitivity": (["sensitivity", "--anatomy", "none.vtu"], "x.csv"),
    "growth": (["benchmarks", "growth", "--element", "p1"], "x.png"),
}
FOLDERS = {
    "scenes": (["scenes", "--anatomy", "none.vtu"], "sheet.png"),
    "report": (["report", "--data", "none.h5"], "index.html"),
    "render": (["render", "press", "--anatomy", "none.vtu"], None),
    "episodes": (["episodes", "none", "--count", "1"], None),
    "warp": (["warp", "none.vtu", "--located", "none.vtu"], None),
}
ALL = {**WRITING, **{name: (words, "x") for name, (words, _) in FOLDERS.items()}}


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that makes no files")
@pytest.mark.parametrize("name", ALL)
def test_commands_check_output_path_before_reading_input(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words, out = ALL[name]
    assert main([*words, "--out", f"/proc/{out}"]) == 2
    error = capsys.readouterr().err
    assert f"/proc/{out}" in error and "errno" not in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that makes no files")
def test_check_output_rejects_path_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot be written there"):
        check_output("/proc/x.vtu", ".vtu")


@pytest.mark.parametrize("name", [*WRITING, "scenes", "report"])
def test_commands_keep_existing_files_without_force(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words, out = WRITING.get(name) or FOLDERS[name]
    mine = tmp_path / out
    mine.write_text("my own")
    where = out if name in WRITING else "."
    assert main([*words, "--out", where]) == 2
    error = capsys.readouterr().err
    assert "--force" in error and out in error and error.count("\n") == 1
    assert mine.read_text() == "my own" and list(tmp_path.iterdir()) == [mine]


def test_force_allows_an_existing_output_file(tmp_path):
    mine = tmp_path / "x.vtu"
    mine.write_text("my own")
    assert check_output_path(mine, ".vtu", force=True) == mine


def test_output_check_creates_no_folder(tmp_path):
    check_output_path(tmp_path / "a" / "b" / "x.vtu", ".vtu")
    assert not list(tmp_path.iterdir())


def test_solve_rejects_its_input_mesh_as_output(tmp_path, capsys):
    """Its `fixed` and `force` would be lost."""
    body = base_held(cube((2, 2, 2)))
    path = tmp_path / "mesh.vtu"
    force = top_forces(body.mesh, np.array([0.0, 0.0, -0.01]))[0]
    write_mesh(path, body.mesh, {"fixed": body.fixed.astype(np.uint8), "force": force})
    before = path.read_bytes()
    (tmp_path / "link.vtu").symlink_to(path)
    for out in ("mesh.vtu", "link.vtu"):
        assert main(["solve", str(path), "--device", "cpu", "--out", str(tmp_path / out), "--force"]) == 2
        assert "would be lost" in capsys.readouterr().err
    assert path.read_bytes() == before
    for force in ([], ["--force"]):
        words = ["--device", "cpu", "--json", "--out", str(tmp_path / "moved.vtu"), *force]
        assert main(["solve", str(path), *words]) == 0
        assert json.loads(capsys.readouterr().out)["outcome"] == "converged"
    assert "displacement" in read_mesh(tmp_path / "moved.vtu").point_data


def test_anatomy_command_keeps_an_existing_scan_file(tmp_path, monkeypatch, capsys):
    mine = to_intensity_path(tmp_path / "me.vtu")
    mine.write_bytes(b"my scan")
    assert main(["anatomy", "--out", str(tmp_path / "me.vtu")]) == 2
    assert "--force" in capsys.readouterr().err
    labels = ["--labels", "none.nii.gz", "--brain", "1", "--tumour", "2", "--t1", str(mine)]
    assert main(["anatomy", *labels, "--force", "--out", str(tmp_path / "me.vtu")]) == 2
    assert "is what this command reads" in capsys.readouterr().err and mine.read_bytes() == b"my scan"


def test_force_selects_only_frame_files_for_removal(tmp_path):
    frame, notes = tmp_path / "frame_0000.png", tmp_path / "frame_notes.png"
    notes.write_bytes(b"mine")
    assert check_output_frames(tmp_path, force=False) == []
    frame.write_bytes(b"a frame")
    with pytest.raises(InputError, match=r"holds 1 frames\. Give --force"):
        check_output_frames(tmp_path, force=False)
    assert check_output_frames(tmp_path, force=True) == [frame]


def put_data(path, **stated):
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "sulcus data 1", **stated})


def test_files_of_another_anatomy_are_found_next_to_mesh(tmp_path):
    mesh = tmp_path / "me.vtu"
    assert find_foreign_files(mesh, "new") == []
    put_data(tmp_path / "me.h5", anatomy="new")
    np.savez(tmp_path / "me.model.npz", header=np.array(json.dumps({"format": "sulcus model 2", "anatomy": "old"})))
    assert find_foreign_files(mesh, "new") == [tmp_path / "me.model.npz"]
    with open_journal(tmp_path / "me.h5.partial", {"anatomy": "old"}):
        pass
    with pytest.raises(InputError, match=r"me.h5.partial and me.model.npz next to it.*--force"):
        check_no_foreign_files(mesh, "new", force=False)
    assert len(check_no_foreign_files(mesh, "new", force=True)) == 2


def test_force_removes_only_data_that_cannot_be_resumed(tmp_path):
    data = tmp_path / "me.h5"
    wanted = {"anatomy": "new", "effects": "e", "seed": "0"}
    put_data(data, **wanted, date="today")
    remove_outdated_data(data, wanted)
    assert data.exists()
    remove_outdated_data(data, {**wanted, "seed": "1"})
    assert not data.exists()


def test_export_of_model_without_mesh_names_anatomy_option(tmp_path, capsys):
    model = tmp_path / "lonely.npz"
    model.write_bytes(b"")
    assert main(["export", str(model), "--out", str(tmp_path / "x.onnx")]) == 2
    assert "lonely.npz.vtu" not in (error := capsys.readouterr().err) and "--anatomy" in error
    assert main(["export", str(tmp_path / "none.model.npz"), "--out", str(tmp_path / "x.onnx")]) == 2
    assert "none.model.npz: no such file" in capsys.readouterr().err
