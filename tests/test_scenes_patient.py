"""Command `sulcus patient`: all steps from scan to models, resumed runs, and rejected input."""

import json

import pytest
from balls import EGG, ball
from programs import main

from scenes.play.deformers import to_model_path
from sim.bodies.intensity import to_intensity_path
from sim.bodies.meshfile import read_anatomy
from sim.material import BRAIN
from sim.runtime.timing import time_stage
from surrogate.model.store import load


def test_patient_command_checks_options_and_passes_them_to_steps(tmp_path, monkeypatch, capsys):
    steps = []
    monkeypatch.setattr("scenes.cli.main", lambda words: steps.append(words) or 0)
    words = ["patient", "labels.nii.gz", "--brain", "1", "--tumour", "2", "--device", "cpu"]
    words += ["--out", str(tmp_path / "me.vtu")]
    assert main([*words, "--force", "--opening-at", "-30,1.5,60"]) == 0
    assert all("--force" in step for step in steps) and "--opening-at=-30.0,1.5,60.0" in steps[0]
    steps.clear()
    (tmp_path / "me.model.npz").write_bytes(b"mine")
    assert main(words) == 2 and not steps
    assert "me.model.npz" in capsys.readouterr().err and not (tmp_path / "me.vtu.partial").exists()


def test_stopped_patient_command_resumes_after_finished_steps(tmp_path, monkeypatch, capsys):
    steps, codes = [], {"anatomy": 2, "simulate": 130, "train": 0}
    made = {"anatomy": "me.vtu", "simulate": "me.h5", "train": "me.model.npz"}

    def step(words):
        steps.append(words[0])
        if codes[words[0]] == 0:
            (tmp_path / made[words[0]]).write_bytes(b"made")
        return codes[words[0]]

    monkeypatch.setattr("scenes.cli.main", step)
    words = ["patient", "labels.nii.gz", "--brain", "1", "--tumour", "2", "--device", "cpu"]
    words += ["--out", str(tmp_path / "me.vtu")]
    assert main(words) == 2 and not list(tmp_path.iterdir())
    codes["anatomy"] = 0
    assert main(words) == 130 and (tmp_path / "me.vtu.partial").exists()
    assert main([*words, "--nodes", "2000"]) == 2 and "was begun with anatomy" in capsys.readouterr().err
    codes["simulate"] = 0
    assert main(words) == 0
    assert steps == ["anatomy", "anatomy", "simulate", "simulate", "train"]
    assert {path.name for path in tmp_path.iterdir()} == set(made.values())
    assert main(words) == 2 and "me.vtu: exists. Give --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "expected"),
    [((), (BRAIN.law, None)), (("--element", "p2", "--material", "corotational"), ("corotational", "p2"))],
)
def test_patient_command_passes_tissue_and_element_to_steps(tmp_path, monkeypatch, words, expected) -> None:
    steps: list[list[str]] = []
    monkeypatch.setattr("scenes.cli.main", lambda step: steps.append(step) or 0)
    labels = ["labels.nii.gz", "--brain", "1", "--tumour", "2"]
    assert main(["patient", *labels, "--out", str(tmp_path / "me.vtu"), "--device", "cpu", *words]) == 0
    assert [step[0] for step in steps] == ["anatomy", "simulate", "train"]
    element = [] if expected[1] is None else ["--element", expected[1]]
    assert steps[1][steps[1].index("--material") :] == ["--material", expected[0], *element]
    assert steps[2][-4:] == ["--learners", "linear,series,series-gp", "--device", "cpu"]


def test_patient_command_runs_all_steps(tmp_path, capsys, short_fits):
    ball(tmp_path, EGG)
    out = tmp_path / "me" / "brain.vtu"
    volumes = [str(tmp_path / "labels.nii.gz"), "--brain", "1", "--tumour", "2", "--t1", str(tmp_path / "t1.nii.gz")]
    size = ["--nodes", "2000", "--count", "80", "--device", "cpu", "--element", "p1", "--learners", "linear,residual"]
    assert main(["patient", *volumes, *size, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    for step in ("sulcus anatomy --labels", "sulcus simulate", "sulcus train", "ready: sulcus demo --anatomy"):
        assert step in text
    for part in ("labels", "mesh", "set-up", "unit responses", "loads", "learn residual", "score", "save", "rest"):
        assert f"\n  {part} " in text
    anatomy = read_anatomy(out)
    models = load(to_model_path(out), anatomy)
    assert set(models) == {"linear", "residual"} and to_intensity_path(out).is_file()
    assert f"ready: sulcus demo --anatomy {out} --element p1" in text
    assert f"sulcus uncertainty press --anatomy {out} --element p1" in text
    here = ["--anatomy", str(out), "--element", "p1"]
    assert main(["check", "slide", "draw", *here, "--every", "30", "--json"]) in (0, 1)  # of eighty loads
    report = json.loads(capsys.readouterr().out)
    best = min(models, key=lambda name: models[name].bound)
    assert all(row["deformer"] == best for row in report["scenes"])
    assert all(row["overlap"] > 0.98 and row["drawn"] < 4.0 and row["printed"] for row in report["scenes"])
    assert all(row["motion_mm"] > 0.3 for row in report["scenes"])
    assert main(["render", "slide", *here, "--every", "60", "--out", str(tmp_path / "frames")]) == 0
    assert len(list((tmp_path / "frames").iterdir())) == 3


def test_sample_patient_inspection_writes_and_keeps_its_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["patient", "--sample", "--inspect"]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("sample label map: sample_labels.nii.gz (1 brain, 2 tumour)\nsample T1: sample_t1.nii.gz\n")
    assert "left anterior superior" in shown and "no warnings" in shown
    files = ["patient.inspect.png", "sample_labels.nii.gz", "sample_t1.nii.gz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == files
    labels, t1 = (tmp_path / name for name in files[1:])
    before, data = (labels.stat().st_mtime_ns, t1.stat().st_mtime_ns), t1.read_bytes()
    assert main([*words, "--json"]) == 0 and json.loads(capsys.readouterr().out)["tumour_ml"] > 7.0
    assert (labels.stat().st_mtime_ns, t1.stat().st_mtime_ns) == before
    labels.unlink()
    t1.write_bytes(b"mine")
    assert main(words) == 2 and "sample_t1.nii.gz: exists. Give --force" in capsys.readouterr().err
    assert not labels.exists() and t1.read_bytes() == b"mine"
    assert main([*words, "--force"]) == 0 and labels.exists() and t1.read_bytes() == data


def test_sample_patient_files_are_passed_to_the_steps(tmp_path, monkeypatch, capsys):
    steps = []
    monkeypatch.setattr("scenes.cli.main", lambda step: steps.append(step) or 0)
    assert main(["patient", "--sample", "--out", str(tmp_path / "new" / "me.vtu"), "--device", "cpu", "--json"]) == 0
    labels, t1 = (tmp_path / "new" / f"sample_{name}.nii.gz" for name in ("labels", "t1"))
    assert steps[0][:6] == ["anatomy", f"--labels={labels}", "--brain=1", "--tumour=2", "--t1", str(t1)]
    assert labels.exists() and t1.exists() and [step[0] for step in steps] == ["anatomy", "simulate", "train"]
    assert json.loads(capsys.readouterr().out)["anatomy"] == str(tmp_path / "new" / "me.vtu")


def test_patient_command_json_has_seconds_of_each_step(tmp_path, monkeypatch, capsys):
    def step(words):
        assert words[-1] == "--json"
        with time_stage(words[0]):
            return 0

    monkeypatch.setattr("scenes.cli.main", step)
    words = ["labels.nii.gz", "--brain", "1", "--tumour", "2", "--device", "cpu", "--json"]
    assert main(["patient", *words, "--out", str(tmp_path / "me.vtu")]) == 0
    said = json.loads(capsys.readouterr().out)
    assert list(said["seconds"]) == ["anatomy", "simulate", "train", "rest"]
    assert sum(said["seconds"].values()) == pytest.approx(said["total"]) and min(said["seconds"].values()) >= 0.0


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["none.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.vtu"], "no such file"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "7", "--out", "a.vtu"], "no label 7"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.stl"], ".vtu"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "labels.nii.gz/a.vtu"], "folder"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.vtu", "--count", "3"], "--count 3"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.vtu", "--device", "abacus"], "abacus"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.vtu", "--learners", "ann,owl"], "called owl"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.vtu", "--learners", "contact"], "contact"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.vtu", "--learners", "ann,"], "--learners"),
        (["labels.nii.gz", "--brain", "1", "--tumour", "2", "--out", "a.vtu", "--nodes", "3"], "3 nodes"),
        (["--brain", "1", "--tumour", "2"], "no label map: give LABELS.nii.gz, or --sample"),
        (["labels.nii.gz", "--sample"], "leave out labels.nii.gz, or --sample"),
        (["--sample", "--t1", "t1.nii.gz"], "leave out t1.nii.gz, or --sample"),
        (["--sample", "--tumour", "2"], "leave out --tumour, or --sample"),
        (["--sample", "--out", "a.vtu", "--count", "3"], "--count 3"),
    ],
)
def test_patient_command_rejects_bad_input_and_writes_nothing(tmp_path, monkeypatch, capsys, words, reason):
    ball(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert main(["patient", *words]) == 2
    error = capsys.readouterr().err
    assert reason in error.splitlines()[-1] and "Traceback" not in error
    assert sorted(tmp_path.iterdir()) == before
