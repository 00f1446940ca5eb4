"""What commands may write: asked before the work, and nothing of a user's is replaced by it."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from boxes import base_held, top_forces
from boxes import box as cube
from programs import main

from ar.optics.calibration import Calibration
from ar.screen import signature, write_film, write_png
from ar.tracking.pages import Page, listed_targets, png_bytes
from ar.tracking.registration import Registration
from scenes.commands.companion_files import demand_no_strangers, remove_data, strangers
from scenes.episodes.exports.card import LICENCE
from scenes.options.outputs import KINDS, claimed, claimed_frames, recognised
from scenes.tracked.calibration_file import write_calibration
from scenes.tracked.film_truth import Truth, write_table, write_truth
from scenes.tracked.registration_file import write_registration
from scenes.tracked.rows import write_rows
from scenes.tracked.tracked_tool import TrackedTool, write_tool
from sim.bodies.intensity import Intensity, sidecar, write_intensity
from sim.bodies.meshfile import read_mesh, write_anatomy, write_mesh
from sim.errors import InputError
from sim.runtime.atomic_files import check_output
from sim.tools import Ball
from surrogate.fitting.tissue import FittedTissue
from surrogate.fitting.tissue_files import save_tissue

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
def test_what_cannot_be_written_is_said_before_anything_is_read(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words, out = ALL[name]
    assert main([*words, "--out", f"/proc/{out}"]) == 2
    error = capsys.readouterr().err
    assert f"/proc/{out}" in error and "errno" not in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that makes no files")
def test_permissions_alone_do_not_make_a_place_to_write(tmp_path):
    with pytest.raises(InputError, match="cannot be written there"):
        check_output("/proc/x.vtu", ".vtu")


@pytest.mark.parametrize("name", [*WRITING, "scenes", "report"])
def test_a_file_of_the_users_is_not_replaced(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words, out = WRITING.get(name) or FOLDERS[name]
    mine = tmp_path / out
    mine.write_text("my own")
    where = out if name in WRITING else "."
    assert main([*words, "--out", where]) == 2
    error = capsys.readouterr().err
    assert "--force" in error and out in error and error.count("\n") == 1
    assert mine.read_text() == "my own" and list(tmp_path.iterdir()) == [mine]


def test_by_force_it_is(tmp_path):
    mine = tmp_path / "x.vtu"
    mine.write_text("my own")
    assert claimed(mine, ".vtu", "an anatomy of sulcus", force=True) == mine


def test_asking_leaves_no_folder_behind(tmp_path):
    claimed(tmp_path / "a" / "b" / "x.vtu", ".vtu", "an anatomy of sulcus")
    assert not list(tmp_path.iterdir())


def test_what_sulcus_wrote_is_recognised_as_what_it_is(tmp_path, box):
    write_anatomy(tmp_path / "anatomy.vtu", box)
    write_mesh(tmp_path / "solution.vtu", box.mesh, {"displacement": np.zeros((len(box.mesh.nodes), 3))})
    write_mesh(tmp_path / "mesh.vtu", box.mesh, {"displacement": box.mesh.nodes, "fixed": box.mesh.nodes})
    write_intensity(
        tmp_path / "scan.t1.nii.gz", Intensity(np.zeros((4, 4, 4), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1]))
    )
    for name, words in (("data", "sulcus data 1"), ("episode", "sulcus episode 1"), ("other", "mine")):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file.attrs["format"] = words
    located = {"displacement": box.mesh.nodes, "deviation": box.mesh.nodes[:, 0]}
    write_mesh(tmp_path / "located.vtu", box.mesh, located)
    np.savez(tmp_path / "locator.npz", header=np.array(json.dumps({"format": "sulcus locator 1"})))
    np.savez(tmp_path / "model.npz", header=np.array(json.dumps({"format": "sulcus model 2"})))
    np.savez(tmp_path / "arrays.npz", mine=np.zeros(3))
    (tmp_path / "graph.onnx").write_bytes(b"\x08\x08 sulcus onnx 1")
    with h5py.File(tmp_path / "demos.hdf5", "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps({"env_name": "sulcus"})
    (tmp_path / "LICENSE.md").write_text(LICENCE)
    save_tissue(tmp_path / "box.tissue.json", FittedTissue("0", 1, np.full((3, 13, 33), 1 / 1287), np.zeros(0)))
    (tmp_path / "table.csv").write_text("what,default,now,force mean_mm\n")
    (tmp_path / "factorial.csv").write_text("opening [mm],depth [mm],skull,nu\n")
    (tmp_path / "index.html").write_text("<!doctype html><title>What accuracy costs in time</title>")
    picture = np.zeros((8, 8, 3), np.uint8)
    write_png(tmp_path / "picture.png", picture)
    write_film(tmp_path / "film.gif", [picture, picture])
    (tmp_path / "page.png").write_bytes(png_bytes(Page("small", picture[..., 0], ())))
    (tmp_path / "targets.json").write_text(json.dumps(listed_targets(), indent=1))
    write_calibration(
        tmp_path / "camera.yaml", Calibration((9.0, 9.0), (4.0, 4.0), 8, 8, name="sulcus calibrate: camera")
    )
    (tmp_path / "camera.json").write_text('{"format": "sulcus intrinsics 1"}')
    write_calibration(tmp_path / "filmed.yaml", Calibration((9.0, 9.0), (4.0, 4.0), 8, 8, name="sulcus film: press"))
    write_tool(tmp_path / "tool.json", TrackedTool(Ball(7e-3)))
    one, place = np.eye(4)[None], np.zeros((1, 3))
    truth = Truth("box", np.zeros(1), one, one, place[None])
    write_truth(tmp_path / "truth.npz", truth)
    write_table(tmp_path / "truth.csv", truth, place)
    write_rows(tmp_path / "rows.csv", [], [])
    write_registration(tmp_path / "registered.json", Registration(np.eye(4), np.eye(6), np.zeros(3), 1e-3, 6))
    (tmp_path / "warp.json").write_text('{\n "format": "sulcus warp 1"\n}')
    (tmp_path / "text.txt").write_text("my own")
    expected = {
        "an anatomy of sulcus": "anatomy.vtu",
        "a scan that sulcus put beside an anatomy": "scan.t1.nii.gz",
        "a result of `sulcus solve`": "solution.vtu",
        "a result of `sulcus locate`": "located.vtu",
        "a locator of `sulcus locate`": "locator.npz",
        "fitted tissue of `sulcus fit`": "box.tissue.json",
        "a data set of `sulcus simulate`": "data.h5",
        "an episode of `sulcus collect`": "episode.h5",
        "a robomimic file of `sulcus convert`": "demos.hdf5",
        "a card of `sulcus convert`": "LICENSE.md",
        "a model of `sulcus train`": "model.npz",
        "a graph of `sulcus export`": "graph.onnx",
        "a table of `sulcus sensitivity`": "table.csv",
        "a table of `sulcus sensitivity --factorial`": "factorial.csv",
        "a page of `sulcus report`": "index.html",
        "a picture of sulcus": "picture.png",
        "a film of `sulcus render`": "film.gif",
        "a page of `sulcus markers`": "page.png",
        "a list of `sulcus markers`": "targets.json",
        "a calibration of `sulcus calibrate`": "camera.yaml",
        "a covariance of `sulcus calibrate`": "camera.json",
        "a registration of `sulcus register`": "registered.json",
        "a camera of `sulcus film`": "filmed.yaml",
        "a tool of `sulcus film`": "tool.json",
        "what is true of a film of `sulcus film`": "truth.npz",
        "a table of `sulcus film`": "truth.csv",
        "a table of `sulcus overlay`": "rows.csv",
        "figures of `sulcus warp`": "warp.json",
    }
    assert set(expected) == set(KINDS)
    for kind, name in expected.items():
        assert [path.name for path in sorted(tmp_path.iterdir()) if recognised(path, kind)] == [name]


def test_solving_does_not_replace_its_own_mesh(tmp_path, capsys):
    """Its `fixed` and `force` would be lost."""
    body = base_held(cube((2, 2, 2)))
    path = tmp_path / "mesh.vtu"
    force = top_forces(body.mesh, np.array([0.0, 0.0, -0.01]))[0]
    write_mesh(path, body.mesh, {"fixed": body.held.astype(np.uint8), "force": force})
    before = path.read_bytes()
    (tmp_path / "link.vtu").symlink_to(path)
    for out in ("mesh.vtu", "link.vtu"):
        assert main(["solve", str(path), "--device", "cpu", "--out", str(tmp_path / out), "--force"]) == 2
        assert "would be lost" in capsys.readouterr().err
    assert path.read_bytes() == before
    for _ in range(2):  # its own result it replaces
        words = ["--device", "cpu", "--json", "--out", str(tmp_path / "moved.vtu")]
        assert main(["solve", str(path), *words]) == 0
        assert json.loads(capsys.readouterr().out)["outcome"] == "converged"
    assert "displacement" in read_mesh(tmp_path / "moved.vtu").point_data


def test_a_users_own_scan_is_neither_replaced_nor_removed(tmp_path, monkeypatch, capsys):
    mine = sidecar(tmp_path / "me.vtu")
    mine.write_bytes(b"my scan")
    assert main(["anatomy", "--out", str(tmp_path / "me.vtu")]) == 2
    assert "--force" in capsys.readouterr().err
    labels = ["--labels", "none.nii.gz", "--brain", "1", "--tumour", "2", "--t1", str(mine)]
    assert main(["anatomy", *labels, "--force", "--out", str(tmp_path / "me.vtu")]) == 2
    assert "is what this command reads" in capsys.readouterr().err and mine.read_bytes() == b"my scan"


def test_frames_of_two_runs_are_not_mixed(tmp_path):
    picture = np.zeros((8, 8, 3), np.uint8)
    one, other, mine = (tmp_path / f"frame_000{k}.png" for k in range(3))
    notes = tmp_path / "frame_notes.png"
    notes.write_bytes(b"mine")
    write_png(one, picture, "run a")
    write_png(tmp_path / "no" / "folder" / "yet.png", picture)
    assert signature(tmp_path / "no" / "folder" / "yet.png") is not None
    write_png(other, picture, "run b")
    assert signature(one) == "run a" and signature(notes) is None
    with pytest.raises(InputError, match="holds 1 frames of another run"):
        claimed_frames(tmp_path, "run a", force=False)
    assert claimed_frames(tmp_path, "run a", force=True) == [other]
    other.unlink()
    assert claimed_frames(tmp_path, "run a", force=False) == []
    mine.write_bytes(b"mine")
    for force in (False, True):
        with pytest.raises(InputError, match="did not write it"):
            claimed_frames(tmp_path, "run a", force)


def put_data(path, **stated):
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "sulcus data 1", **stated})


def test_data_and_models_of_another_anatomy_are_found_beside_a_mesh(tmp_path):
    mesh = tmp_path / "me.vtu"
    assert strangers(mesh, "new") == []
    put_data(tmp_path / "me.h5", anatomy="new")
    np.savez(tmp_path / "me.model.npz", header=np.array(json.dumps({"format": "sulcus model 2", "anatomy": "old"})))
    assert strangers(mesh, "new") == [tmp_path / "me.model.npz"]
    (tmp_path / "me.h5.partial").write_bytes(b"sulcus\r\n\0run\0" + json.dumps({"anatomy": "old"}).encode() + b"\0\x01")
    with pytest.raises(InputError, match=r"me.h5.partial and me.model.npz beside it.*--force"):
        demand_no_strangers(mesh, "new", force=False)
    assert len(demand_no_strangers(mesh, "new", force=True)) == 2


def test_force_removes_only_data_that_cannot_go_on(tmp_path):
    data = tmp_path / "me.h5"
    wanted = {"anatomy": "new", "effects": "e", "seed": "0"}
    put_data(data, **wanted, date="today")
    remove_data(data, wanted)
    assert data.exists()
    remove_data(data, {**wanted, "seed": "1"})
    assert not data.exists()


def test_a_model_without_its_mesh_says_what_to_give(tmp_path, capsys):
    model = tmp_path / "lonely.npz"
    model.write_bytes(b"")
    assert main(["export", str(model), "--out", str(tmp_path / "x.onnx")]) == 2
    assert "lonely.npz.vtu" not in (error := capsys.readouterr().err) and "--anatomy" in error
    assert main(["export", str(tmp_path / "none.model.npz"), "--out", str(tmp_path / "x.onnx")]) == 2
    assert "none.model.npz: no such file" in capsys.readouterr().err
