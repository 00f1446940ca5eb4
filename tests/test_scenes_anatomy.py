"""`sulcus anatomy` on the command line: meshes of the template and of label maps, and rejected input."""

import json

import numpy as np
import pytest
from balls import ball

from scenes.cli import main
from sim.bodies.intensity import read_intensity, to_intensity_path
from sim.bodies.meshfile import read_anatomy, write_anatomy


def run(capsys, *words):
    code = main(["anatomy", *map(str, words)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture
def brain(tmp_path):
    """A folder with `labels.nii.gz` and `t1.nii.gz`."""
    ball(tmp_path)
    return tmp_path


def test_template_anatomy_with_intensities_round_trips(tmp_path, capsys):
    out = tmp_path / "brain.vtu"
    code, text, _ = run(capsys, "--nodes", 2000, "--preset", "superficial", "--json", "--out", out)
    summary = json.loads(text)
    anatomy = read_anatomy(out)
    assert code == 0 and summary["digest"] == anatomy.digest and summary["nodes"] == len(anatomy.mesh.nodes)
    assert summary["worst_dihedral_deg"] >= 10.0 and abs(summary["tumour_volume_error_percent"]) < 2.0
    write_anatomy(tmp_path / "again.vtu", anatomy)
    assert read_anatomy(tmp_path / "again.vtu").digest == anatomy.digest
    # Three millimetres under the opened cortex there is grey matter to be seen.
    nodes = anatomy.mesh.nodes[anatomy.craniotomy]
    inward = anatomy.mesh.nodes.mean(axis=0) - nodes
    grey = read_intensity(to_intensity_path(out)).interpolate(
        nodes + 3e-3 * inward / np.linalg.norm(inward, axis=1, keepdims=True)
    )
    assert 0.3 < grey.mean() < 0.95 and grey.std() > 0.02
    code, text, _ = run(capsys, "--nodes", 2000, "--preset", "superficial", "--out", tmp_path / "second.vtu")
    assert code == 0 and "2.0" not in text.split()[0] and "mm mean" in text and "ml" in text
    assert read_anatomy(tmp_path / "second.vtu").digest == anatomy.digest


def test_anatomy_command_meshes_labels_with_and_without_t1(brain, capsys):
    out = brain / "mine.vtu"
    words = ("--labels", brain / "labels.nii.gz", "--brain", "1", "--tumour", "2", "--nodes", 2000, "--out", out)
    code, text, noted = run(capsys, *words, "--t1", brain / "t1.nii.gz")
    assert code == 0 and "intensities to" in text and "ask for more nodes" not in noted
    grey = read_intensity(to_intensity_path(out))
    left, right = grey.interpolate(np.array([[0.010, 0.0, 0.03], [0.030, 0.0, 0.03]]))
    assert right > left + 0.05
    code, text, _ = run(capsys, *words, "--force")
    assert code == 0 and "intensities" not in text
    assert not to_intensity_path(out).exists()  # those of the earlier mesh do not belong to this one


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--nodes", "100"), "100 nodes are outside"),
        (("--craniotomy", "nan"), "craniotomy of nan mm"),
        (("--radius", "-3"), "radius of -3 mm"),
        (("--brain", "1"), "give --labels"),
        (("--t1", "x.nii"), "give --labels"),
        (("--regions", "oedema"), "--regions belongs to a label volume"),
        (("--labels", "labels.nii.gz", "--brain", "1"), "at least one label of the tumour"),
        (("--labels", "labels.nii.gz", "--brain", "1", "--tumour", "5"), "has no label 5"),
        (("--labels", "labels.nii.gz", "--brain", "1", "--tumour", "2", "--radius", "5"), "leave it out"),
        (("--labels", "none.nii.gz", "--brain", "1", "--tumour", "2"), "no such file"),
    ],
)
def test_anatomy_command_rejects_bad_input_and_writes_nothing(brain, capsys, monkeypatch, words, reason):
    monkeypatch.chdir(brain)
    before = sorted(brain.iterdir())
    code, text, error = run(capsys, *words, "--out", "mine.vtu")
    assert code == 2 and not text
    assert reason in error and error.count("\n") == 1
    assert sorted(brain.iterdir()) == before


def test_anatomy_command_rejects_unsupported_file_extension(tmp_path, capsys):
    code, _, error = run(capsys, "--out", tmp_path / "brain.stl")
    assert code == 2 and ".vtu" in error
