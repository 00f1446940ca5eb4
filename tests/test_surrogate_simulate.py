"""Commands `sulcus simulate` and `sulcus train` with finite elements."""

import json
import re

import h5py
import numpy as np
import pytest

from scenes.cli import main
from sim.bodies.meshfile import write_anatomy
from surrogate.data.dataset import read_dataset
from surrogate.data.tool_loads import OVERLOAD_PRESETS
from surrogate.model.store import load, read_reported_errors
from surrogate.training.train import LEARNERS


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_box):
    path = tmp_path_factory.mktemp("commands")
    write_anatomy(path / "box.vtu", small_box)
    assert main(["simulate", str(path / "box.vtu"), "--out", str(path / "data.h5"), "--count", "100"]) == 0
    return path


def test_dataset_records_its_provenance(folder, small_box):
    data = read_dataset(folder / "data.h5")
    assert data.good.all() and len(data.loads) == 100 and data.anatomy.digest == small_box.digest
    assert data.residual.max() <= 1e-4 and data.iterations.min() >= 1
    for name in (
        "anatomy",
        "effects",
        "accuracy",
        "device",
        "preset",
        "seed",
        "sulcus version",
        "warp-lang version",
        "frame",
    ):
        assert data.provenance[name]
    assert "law='neo-hookean'" in data.provenance["effects"] and "0.0001" in data.provenance["accuracy"]
    assert "limit_strain=True" in data.provenance["accuracy"]


def test_simulate_keeps_strained_results_of_brutal_loads(folder, tmp_path):
    """So are those of the published protocol, whose loads do not fit on small bodies."""
    out = tmp_path / "data.h5"
    words = f"simulate {folder / 'box.vtu'} --tool-preset brutal --count 2 --device cpu --json".split()
    assert main([*words, "--out", str(out)]) == 0 and OVERLOAD_PRESETS == ("seed", "brutal")
    assert "limit_strain=False" in read_dataset(out).provenance["accuracy"]


def test_stored_displacements_match_finite_elements(folder, small_box):
    from sim.effects import Elasticity, Held, ToolForce
    from sim.fem import Fem

    data = read_dataset(folder / "data.h5")
    truth = Fem(small_box, (Elasticity(), Held(), ToolForce()), device="cpu").deform(data.loads.select(np.arange(3)))
    stored = data.read_displacement(slice(None))[:3]
    assert np.linalg.norm(stored - truth.displacement) < 1e-3 * np.linalg.norm(truth.displacement)


def test_train_command_reports_and_writes_every_model(folder, small_box, capsys, short_fits):
    out = folder / "model.npz"
    assert main(["train", str(folder / "data.h5"), "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    rows = {row["name"]: row for row in report["scores"]}
    assert set(rows) == set(LEARNERS) == set(load(out, small_box))
    figures = {f"{figure}_{unit}" for figure in ("mean", "p95", "max") for unit in ("mm", "percent")}
    for row in rows.values():
        assert figures | {"microseconds", "bound_mm"} <= set(row) and all(row[name] > 0 for name in figures)
        assert row["p999_mm"] is row["p999_percent"] is None  # of so few loads
    # A box so coarse has few nodes outside the discs to interpolate from: the linear share is off too.
    assert rows["linear"]["mean_percent"] < 16.0 and rows["series"]["mean_percent"] < rows["linear"]["mean_percent"]
    assert report["winner"] == min(rows.values(), key=lambda row: row["mean_mm"])["name"]
    assert report["discs"] >= 6 and report["share_of_patch"] >= 0.15
    assert report["training_loads"] + report["held_out"] + report["calibrated"] == 100
    assert report["nominal_refused"] == pytest.approx(0.10, abs=0.005)
    solves = {name: row["solves"] for name, row in rows.items()}
    assert {count["loads"] for count in solves.values()} == {report["training_loads"]}
    assert solves["series"]["series"] > 0 == solves["svr"]["series"] and solves["series"]["seconds"] > 0.0
    assert main(["train", str(folder / "data.h5"), "--out", str(folder / "table.npz"), "--learners", "linear"]) == 0
    printed = capsys.readouterr().out
    assert (
        "smallest error" not in printed
        and "linear: " in printed
        and "10 % of the nominal loads of palpation" in printed
    )
    assert "a load's worst vertex" in printed and "NumPy model" in printed


def test_repeated_simulate_command_solves_no_load(folder, capsys):
    command = ["simulate", str(folder / "box.vtu"), "--out", str(folder / "data.h5"), "--count", "100", "--json"]
    before = (folder / "data.h5").read_bytes()
    assert main(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["solved_now"] == 0 and said["loads_per_second"] is None
    assert (folder / "data.h5").read_bytes() == before
    assert main([*command, "--young", "6000"]) == 2
    assert "effects" in capsys.readouterr().err and (folder / "data.h5").read_bytes() == before


def test_doubled_stiffness_halves_unit_responses(folder, tmp_path, capsys):
    out = tmp_path / "stiff.h5"
    command = ["simulate", str(folder / "box.vtu"), "--out", str(out), "--count", "2", "--material", "linear", "--json"]
    assert main([*command, "--young", "6000"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["loads_per_second"] == pytest.approx(2 / said["seconds"]["loads"])
    soft, stiff = read_dataset(folder / "data.h5"), read_dataset(out)
    tumour = soft.anatomy.tumour_nodes
    ratio = np.linalg.norm(soft.compute_unit_response(tumour)) / np.linalg.norm(stiff.compute_unit_response(tumour))
    assert ratio == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--count", "0"], "--count"),
        (["--batch", "0"], "batch is 0"),
        (["--poisson", "0.5"], "Poisson"),
        (["--tolerance", "2"], "tolerance"),
        (["--device", "tpu"], "device"),
    ],
)
def test_simulate_rejects_invalid_options(folder, tmp_path, capsys, options, words):
    assert main(["simulate", str(folder / "box.vtu"), "--out", str(tmp_path / "data.h5"), *options]) == 2
    assert words in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_commands_reject_missing_files_and_wrong_suffixes(folder, tmp_path, capsys):
    assert main(["simulate", str(tmp_path / "none.vtu"), "--out", str(tmp_path / "data.h5")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["simulate", str(folder / "box.vtu"), "--out", str(tmp_path / "data.txt")]) == 2
    assert ".h5" in capsys.readouterr().err
    assert main(["train", str(tmp_path / "none.h5"), "--out", str(tmp_path / "model.npz")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["train", str(folder / "data.h5"), "--out", str(tmp_path / "model.pkl")]) == 2
    assert ".npz" in capsys.readouterr().err
    assert main(["train", str(folder / "data.h5"), "--out", str(tmp_path / "m.npz"), "--learners", "forest"]) == 2
    assert "forest" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_train_rejects_damaged_data_file(folder, tmp_path, capsys):
    damaged = tmp_path / "data.h5"
    content = (folder / "data.h5").read_bytes()
    damaged.write_bytes(content[: len(content) // 2])
    assert main(["train", str(damaged), "--out", str(tmp_path / "model.npz")]) == 2
    assert "cannot be read" in capsys.readouterr().err
    damaged.write_bytes(content)
    with h5py.File(damaged, "r+") as file:
        file["anatomy/nodes"][0] += 1e-4
    assert main(["train", str(damaged), "--out", str(tmp_path / "model.npz")]) == 2
    assert "was changed" in capsys.readouterr().err


def test_judge_rejects_loads_of_the_training(folder, small_box, capsys):
    data, model, fresh = (str(folder / name) for name in ("data.h5", "table.npz", "fresh.h5"))
    assert (
        main(["train", data, "--out", model, "--learners", "linear", "--device", "cpu,cpu", "--json", "--force"]) == 0
    )
    words = ["--count", "60", "--device", "cpu", "--json"]
    assert main(["simulate", str(folder / "box.vtu"), "--out", fresh, "--seed", "9", *words]) == 0
    capsys.readouterr()
    assert main(["judge", model, fresh, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    answers = read_dataset(fresh)
    guess = load(model, small_box)["linear"].deform(answers.loads, at=small_box.tumour_nodes)
    miss = np.linalg.norm(guess.displacement - answers.read_displacement(small_box.tumour_nodes), axis=2)
    assert said["scores"][0]["mean_mm"] == pytest.approx(1e3 * miss.mean(), rel=1e-6)
    found = said["coverage"]["linear"]
    assert found["shares"] == [np.mean(miss.max(axis=1) <= guess.bound[0]), None] and np.isinf(guess.bound[1]).all()
    assert np.mean(found["tenths"]) == pytest.approx(found["shares"][0]) and len(found["tenths"]) == 10
    assert found["bound_mm"] == pytest.approx(1e3 * np.median(guess.bound[0])) and found["loads"] == 60
    assert main(["judge", model, fresh]) == 0
    assert "bounds cover" in capsys.readouterr().out
    little, few = str(folder / "little.h5"), str(folder / "few.npz")
    count = ["--count", "40", "--device", "cpu", "--json"]  # of which too few calibrate
    assert main(["simulate", str(folder / "box.vtu"), "--out", little, *count]) == 0
    assert main(["train", little, "--out", few, "--learners", "linear"]) == 0
    printed, (weak,) = capsys.readouterr().out, [known.is_weak for known in read_reported_errors(few).values()]
    said = "scenes play it guarded" if weak else "scenes play it without FEM"
    assert re.search(rf"\(limit [\d.]+ (?:mm|%)\): {said}", printed)
    assert main(["judge", few, fresh]) == 0
    printed = capsys.readouterr().out
    assert "linear: has no bounds\n" in printed and "bounds cover" not in printed
    other, few_loads = str(folder / "other.h5"), ["--count", "6", "--device", "cpu"]
    for words in (["--young", "6000"], ["--region", "tumour:6000", "--force"]):
        assert main(["simulate", str(folder / "box.vtu"), "--out", other, *words, *few_loads]) == 0
        assert main(["judge", model, other]) == 2
        assert "would include this difference" in capsys.readouterr().err
    assert main(["judge", model, data]) == 2
    assert "was trained: simulate others" in capsys.readouterr().err


def test_interrupt_message_is_on_its_own_line(folder, tmp_path, monkeypatch, capsys):
    """The progress bar is ended first; a command that cannot resume reports only that it stopped."""

    def stopped(path, deformer, loads, provenance, batch, progress):
        progress(3, 40)
        raise KeyboardInterrupt

    monkeypatch.setattr("scenes.commands.simulate.simulate", stopped)
    words = ["simulate", str(folder / "box.vtu"), "--out", str(tmp_path / "a.h5"), "--count", "40", "--device", "cpu"]
    assert main(words) == 130
    *before, last = capsys.readouterr().err.splitlines()
    assert f"run the same command again to resume from {tmp_path / 'a.h5'}.partial" in last and "3/40" in before[-1]

    def stopped_too(*given, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("scenes.commands.train.train", stopped_too)
    assert main(["train", str(folder / "data.h5"), "--out", str(tmp_path / "model.npz")]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "sulcus train: stopped"
