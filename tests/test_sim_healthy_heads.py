"""Healthy heads in which `sulcus anatomy` places a tumour: a mask's, and fsaverage's inner skull."""

import importlib
import json
import sys

import nibabel
import numpy as np
import pytest
from balls import EGG, ball
from scipy.spatial import ConvexHull

from scenes.cli import main
from sim.bodies.healthy_heads import INNER_SKULL
from sim.bodies.intensity import read_intensity, to_intensity_path
from sim.bodies.meshfile import read_anatomy

RADII = 0.080 * EGG
BALL_ML = 4e6 / 3.0 * np.pi * RADII.prod()


def run(capsys, *words):
    code = main(["anatomy", *map(str, words)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def egg(count=4000):
    """Vertices (n, 3) [m] and triangles (m, 3) of an ellipsoid, which are turned either way."""
    directions = np.random.default_rng(3).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return RADII * directions, ConvexHull(directions).simplices


PACKAGE = """
from numpy import load

def read_bem_surfaces(path, verbose):
    return [dict(load(path))]
"""


def write_skull(path, points, triangles):
    with path.open("wb") as file:
        np.savez(file, rr=points, tris=triangles)


@pytest.fixture
def skull(tmp_path, monkeypatch):
    """Path of the skull, an ellipsoid, in a package mne that reads its own format."""
    path = tmp_path / "packages" / "mne" / INNER_SKULL
    path.parent.mkdir(parents=True)
    (tmp_path / "packages" / "mne" / "__init__.py").write_text(PACKAGE)
    write_skull(path, *egg())
    monkeypatch.syspath_prepend(tmp_path / "packages")
    monkeypatch.delitem(sys.modules, "mne", raising=False)
    importlib.invalidate_caches()
    yield path
    sys.modules.pop("mne", None)


def test_fsaverage_has_its_inner_skull_and_size(skull, tmp_path, capsys):
    words = ("--head", "fsaverage", "--brain-volume", 1300, "--nodes", 2000, "--cover", 8, "--json")
    code, text, _ = run(capsys, *words, "--out", tmp_path / "fs.vtu")
    summary = json.loads(text)
    nodes = read_anatomy(tmp_path / "fs.vtu").mesh.nodes
    assert code == 0 and summary["brain_ml"] == pytest.approx(1300, rel=0.01)
    assert np.ptp(nodes, axis=0) == pytest.approx(2.0 * RADII * (1300 / BALL_ML) ** (1 / 3), rel=0.02)
    assert summary["opening"]["side"] == "right superior" and summary["t1"] is None
    assert abs(summary["tumour_volume_error_percent"]) < 2.0


def test_wrong_file_at_path_of_skull_is_rejected(skull, tmp_path, capsys):
    skull.write_bytes(b"another's file")
    code, text, error = run(capsys, "--head", "fsaverage", "--out", tmp_path / "fs.vtu")
    assert code == 2 and not text and not (tmp_path / "fs.vtu").exists()
    assert (
        error.startswith("sulcus anatomy: ") and str(skull) in error and "Reinstall" in error and error.count("\n") == 1
    )


def test_missing_or_open_skull_surface_is_rejected(skull, tmp_path, capsys, monkeypatch):
    points, triangles = egg()
    write_skull(skull, points, triangles[1:])
    code, _, error = run(capsys, "--head", "fsaverage", "--out", tmp_path / "fs.vtu")
    assert code == 2 and f"{skull}: the surface is not closed" in error
    skull.unlink()
    code, _, error = run(capsys, "--head", "fsaverage", "--out", tmp_path / "fs.vtu")
    assert code == 2 and f"{skull}: no such file" in error and "pip install -e '.[heads]'" in error
    monkeypatch.setitem(sys.modules, "mne", None)  # as where it is not installed
    code, _, error = run(capsys, "--head", "fsaverage", "--out", tmp_path / "fs.vtu")
    assert code == 2 and "mne, which is not installed" in error and "pip install -e '.[heads]'" in error


@pytest.fixture
def masked(tmp_path):
    """A folder with `brain.nii.gz`, an ellipsoid far from the origin and a speck; `t1.nii.gz`, light on the right."""
    ball(tmp_path, EGG)
    for name in ("labels", "t1"):
        image = nibabel.load(tmp_path / f"{name}.nii.gz")
        values, affine = np.asarray(image.dataobj).copy(), image.affine.copy()
        affine[:3, 3] += [10.0, 60.0, -40.0]
        if name == "labels":
            values[2:4, 2:4, 2:4] = 1
        else:
            values = np.where(values > 90.0, 100.0, 20.0)  # 20 mm to the right of the ellipsoid's middle
        nibabel.save(nibabel.Nifti1Image(values, affine), tmp_path / f"{name}.nii.gz")
    (tmp_path / "labels.nii.gz").rename(tmp_path / "brain.nii.gz")
    return tmp_path


def test_mask_with_t1_receives_a_synthetic_tumour(masked, capsys):
    words = ("--mask", masked / "brain.nii.gz", "--t1", masked / "t1.nii.gz", "--nodes", 2000, "--radius", 10, "--json")
    code, text, noted = run(capsys, *words, "--out", masked / "own.vtu")
    own = json.loads(text)
    assert code == 0 and f"{masked / 'brain.nii.gz'}: left out 0.064 ml" in noted
    assert own["septa_nodes"] == {} and own["brain_ml"] == pytest.approx(
        4e-3 / 3 * np.pi * 55.0**3 * EGG.prod(), rel=0.01
    )
    # Of an ellipsoid round (10, 60, -40) the central site lies on the right and above.
    at = np.array(own["opening"]["at_mm"]) - [10.0, 60.0, -40.0]
    assert np.linalg.norm(at / (55.0 * EGG)) == pytest.approx(1.0, abs=0.05)
    direction = np.array([40.0, 3.4, 52.6])
    assert at @ direction > 0.99 * np.linalg.norm(at) * np.linalg.norm(direction)
    code, text, _ = run(capsys, *words, "--brain-volume", 1400, "--falx-depth", 20, "--out", masked / "large.vtu")
    large, factor = json.loads(text), (1400 / own["brain_ml"]) ** (1 / 3)
    assert code == 0 and large["brain_ml"] == pytest.approx(1400, rel=0.01) and large["septa_nodes"]["falx"] > 10
    walls = read_anatomy(masked / "large.vtu")
    held = walls.mesh.nodes[walls.fixed.all(axis=1), 0]
    assert (np.abs(held - 10e-3) < 10e-3).sum() > 0.8 * large["septa_nodes"]["falx"]  # round the mask's middle
    assert large["tumour_ml"] == pytest.approx(own["tumour_ml"], rel=0.02)  # the tumour keeps its size
    grown = np.array(large["opening"]["at_mm"]) - [10.0, 60.0, -40.0]
    assert grown == pytest.approx(at * factor, abs=1.5)
    for one, border in ((own, 20.0), (large, 20.0 * factor)):
        across = np.arange(5.0, 40.0, 0.1)
        line = np.array([10.0 + across, *np.outer(one["opening"]["at_mm"][1:], np.ones(len(across)))]).T
        grey = read_intensity(to_intensity_path(one["mesh"])).interpolate(1e-3 * line)
        assert np.ptp(grey) > 0.3 and across[np.searchsorted(grey, grey.mean())] == pytest.approx(border, abs=1.5)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--mask", "none.nii.gz"), "none.nii.gz: no such file"),
        (("--mask", "zero.nii.gz"), "zero.nii.gz: all voxels are 0"),
        (("--mask", "tiny.nii.gz"), "make a brain of 0.064 ml"),
        (("--mask", "brain.nii.gz", "--head", "fsaverage"), "leave one of them out"),
        (("--mask", "brain.nii.gz", "--brain-volume", "nan"), "--brain-volume nan is outside 20 to 5000"),
        (("--mask", "brain.nii.gz", "--radius", "35", "--cover", "60"), "reaches out of the brain"),
        (("--mask", "brain.nii.gz", "--tumour", "2"), "--tumour belongs to a label volume"),
        (("--mask", "brain.nii.gz", "--radius", "5", "--falx-depth", "70"), "a falx of 70 mm is outside 10 to 60 mm"),
        (("--labels", "brain.nii.gz", "--falx-depth", "35"), "--falx-depth draws in a healthy head"),
        (("--head", "fsaverage", "--t1", "t1.nii.gz"), "give --labels or --mask"),
        (("--labels", "brain.nii.gz", "--brain", "1", "--tumour", "2", "--head", "template"), "leave it out with"),
    ],
)
def test_invalid_head_is_rejected_and_nothing_is_written(masked, capsys, monkeypatch, words, reason):
    monkeypatch.chdir(masked)
    image = nibabel.load("brain.nii.gz")
    for name, kept in (("zero", 0), ("tiny", 4)):
        values = np.zeros(image.shape, np.uint8)
        values[2 : 2 + kept // 2, 2 : 2 + kept // 2, 2 : 2 + kept // 2] = 1
        nibabel.save(nibabel.Nifti1Image(values, image.affine), f"{name}.nii.gz")
    before = sorted(masked.iterdir())
    code, text, error = run(capsys, *words, "--out", "mine.vtu")
    assert code == 2 and not text
    assert reason in error and error.count("\n") == 1
    assert sorted(masked.iterdir()) == before
