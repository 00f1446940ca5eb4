"""`sulcus patient --inspect`: figures, image and warnings before an anatomy is made."""

import json

import nibabel
import numpy as np
import pytest
from balls import ball
from PIL import Image
from scipy import ndimage

from scenes.cli import main
from scenes.commands.inspection_sheet import COLOURS, SIDE

RED, GREEN = COLOURS["tumour"], COLOURS["opening"]


def inspect_subject(capsys, folder, *words):
    code = main(["patient", *map(str, words), "--out", str(folder / "p.vtu"), "--inspect", "--json"])
    said = capsys.readouterr()
    assert code == 0, said.err
    return json.loads(said.out), np.asarray(Image.open(folder / "p.inspect.png"))


def compute_middle(panel, colour):
    """Column and row of the middle of the pixels of a colour, in shares of the panel."""
    rows, columns = np.nonzero((panel == colour).all(axis=2))
    return columns.mean() / SIDE, rows.mean() / SIDE


def test_inspection_reports_volumes_depth_and_directions(tmp_path, capsys):
    """Ball of 55 mm at the origin, with a ball of 10 mm, 20 mm to the right and up."""
    ball(tmp_path)
    found, picture = inspect_subject(capsys, tmp_path, tmp_path / "labels.nii.gz", "--brain", 1, "--tumour", 2)
    assert found["brain_ml"] == pytest.approx(4 / 3 * np.pi * 55**3 / 1e3, rel=0.01)
    assert found["tumour_ml"] == pytest.approx(552 * 0.008)
    assert found["depth_mm"] == pytest.approx(55 - 10 - np.hypot(20, 20), abs=2.0)
    assert found["distance_mm"] == pytest.approx(found["depth_mm"], abs=2.0)
    np.testing.assert_allclose(found["opening"]["at_mm"], 55 / np.sqrt(2) * np.array([1, 0, 1]), atol=3.0)
    assert found["axes"] == "RAS" and not found["mirrored"] and found["voxel_mm"] == [2.0] * 3
    assert found["warnings"] == ["a brain of 695 ml is small for an adult: is the mask whole?"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["labels.nii.gz", "p.inspect.png", "t1.nii.gz"]
    # The legend has what is drawn, a tumour under the opening among it, and no tumour that is left out.
    legend = picture[:, 2 * SIDE :].reshape(-1, 3)
    shadow = (0.55 * np.array(GREEN) + 0.45 * np.array(RED)).astype(np.uint8)
    for colour, there in ((RED, True), (shadow, True), (COLOURS["brain"], True), (COLOURS["left out"], False)):
        assert (legend == colour).all(axis=1).any() == there
    axial, coronal = picture[:SIDE, :SIDE], picture[:SIDE, SIDE : 2 * SIDE]
    sagittal, outside = picture[SIDE:, :SIDE], picture[SIDE:, SIDE : 2 * SIDE]
    # As radiologists have it, the right is on the left; half of the side is 61 mm.
    off = 20.0 / 122.0
    np.testing.assert_allclose(compute_middle(axial, RED), [0.5 - off, 0.5], atol=0.02)
    np.testing.assert_allclose(compute_middle(coronal, RED), [0.5 - off, 0.5 - off], atol=0.02)
    np.testing.assert_allclose(compute_middle(sagittal, RED), [0.5, 0.5 - off], atol=0.02)
    column, row = compute_middle(coronal, GREEN)
    assert column < 0.25 and row < 0.25
    # From outside, the opening has its diameter, and the tumour's shadow lies in its middle.
    green = (outside[..., 1] > outside[..., 0] * 1.3) & (outside[..., 1] > outside[..., 2] * 1.3)
    whole = ndimage.binary_fill_holes(green)
    np.testing.assert_allclose(ndimage.center_of_mass(whole), [SIDE / 2, SIDE / 2], atol=0.03 * SIDE)
    shadow = whole & ~green
    assert np.sqrt(whole.sum() / shadow.sum()) == pytest.approx(50.0 / 22.0, rel=0.15)


def test_inspection_warns_of_suspicious_labels_and_spaces(tmp_path, capsys):
    ball(tmp_path)
    image = nibabel.load(tmp_path / "labels.nii.gz")
    labels, affine = np.asarray(image.dataobj).copy(), np.diag([-1.0, 1.0, 1.0, 1.0]) @ image.affine
    index = np.moveaxis(np.indices(labels.shape), 0, -1)
    labels[np.linalg.norm(2.0 * (index - 31.5) - [0.0, 50.0, 0.0], axis=-1) < 8.0] = 2
    nibabel.save(nibabel.Nifti1Image(labels, affine), tmp_path / "mirrored.nii")
    nibabel.save(nibabel.Nifti1Image(np.ones((20, 64, 64), np.uint8), image.affine), tmp_path / "part.nii")
    words = (tmp_path / "mirrored.nii", "--brain", 1, "--tumour", 2, "--t1", tmp_path / "part.nii")
    found, picture = inspect_subject(capsys, tmp_path, *words, "--opening-at", "0,-55,0")
    said = " ".join(found["warnings"])
    for part in ("touches the cortex", "lies in 2 pieces", "the T1 holds", "mm from the tumour: pressing"):
        assert part in said
    assert found["axes"] == "LAS" and found["mirrored"]
    assert [piece["side"] for piece in found["tumour_pieces"]] == ["left superior", "midline anterior"]
    assert compute_middle(picture[:SIDE, :SIDE], GREEN)[1] > 0.8
    # From behind, the left is on the left: there is the larger piece, higher up.
    outside = picture[SIDE:, SIDE : 2 * SIDE].astype(float)
    shadow = (outside[..., 0] > 1.3 * outside[..., 1]) & (outside[..., 0] > 1.3 * outside[..., 2])
    rows, columns = np.nonzero(shadow)
    assert columns.min() < 0.35 * SIDE and rows.min() < 0.35 * SIDE and columns.max() < 0.6 * SIDE
    assert main(["patient", *map(str, words[:-2]), "--out", str(tmp_path / "p.vtu"), "--inspect"]) == 0
    text = capsys.readouterr().out
    assert main(["patient", *map(str, words[:-2]), "--out", str(tmp_path / "p.txt"), "--inspect"]) == 2
    assert ".vtu" in capsys.readouterr().err
    # Before anything is read: these labels are not there.
    for more in ((), ("--inspect",)):
        refused = ["patient", "none.nii", "--out", str(tmp_path / "p.vtu"), "--nodes", "1999", *more]
        assert main(refused) == 2 and "1999 nodes are outside 2000 to" in capsys.readouterr().err
    assert "stored LAS (mirrored, as many scanners do; sides from its affine)" in text and "warnings:" in text


def test_inspection_creates_missing_folder_unless_path_is_a_file(tmp_path, capsys):
    ball(tmp_path)
    (tmp_path / "file").touch()
    words = ["patient", str(tmp_path / "labels.nii.gz"), "--brain", "1", "--tumour", "2", "--inspect", "--out"]
    assert main([*words, str(tmp_path / "new" / "a" / "p.vtu")]) == 0
    assert [path.name for path in (tmp_path / "new" / "a").iterdir()] == ["p.inspect.png"]
    assert main([*words, str(tmp_path / "file" / "p.vtu")]) == 2
    assert "cannot be created" in capsys.readouterr().err


LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def moved(folder, name, to, affine, crop=None):
    """A file of the ball with another affine; with `crop`, without its last voxels."""
    image = nibabel.load(folder / f"{name}.nii.gz")
    nibabel.save(nibabel.Nifti1Image(np.asarray(image.dataobj)[..., :crop], affine), folder / to)
    return folder / to


def test_inspection_rejects_lps_scan_labelled_as_ras(tmp_path, capsys):
    """On the grid of the labels, with either file wrong; and on a separate grid, which misses the brain."""
    ball(tmp_path)
    labels, affine = tmp_path / "labels.nii.gz", nibabel.load(tmp_path / "labels.nii.gz").affine
    far = affine.copy()
    far[:2, 3] += 80.0
    wrong, own = moved(tmp_path, "t1", "lps.nii", LPS @ affine), moved(tmp_path, "t1", "own.nii", LPS @ far, -2)
    for given, scan, said in (
        (labels, wrong, f"lps.nii: has the grid of {labels}, but with x and y negated"),
        (moved(tmp_path, "labels", "wrong.nii", LPS @ affine), tmp_path / "t1.nii.gz", "t1.nii.gz: has the grid of"),
        (moved(tmp_path, "labels", "far.nii", far), own, "own.nii: holds 0 % of the brain of"),
    ):
        for words in (["anatomy", "--labels", given], ["patient", given, "--inspect"]):
            words += ["--brain", 1, "--tumour", 2, "--t1", scan, "--out", tmp_path / "p.vtu"]
            assert main([str(word) for word in words]) == 2
            assert said in (error := capsys.readouterr().err) and "one of the two states LPS as RAS" in error


def test_inspection_notes_tumour_side_of_differing_grid(tmp_path, capsys):
    ball(tmp_path)
    labels = tmp_path / "labels.nii.gz"
    own = moved(tmp_path, "labels", "own.nii", nibabel.load(labels).affine, -2)
    for marked, count in ((own, 1), (labels, 0)):
        found, _ = inspect_subject(capsys, tmp_path, labels, "--brain", 1, "--tumour-in", marked, "--tumour", 2)
        notes = [one for one in found["warnings"] if one.startswith(f"{marked}: has a grid of its own")]
        assert len(notes) == count and all(note.endswith("tumour lies right superior") for note in notes)
