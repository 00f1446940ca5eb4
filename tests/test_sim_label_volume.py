"""Label volumes of many kinds become meshes in their own frame, or are rejected with a message."""

import json

import nibabel
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes.cli import main
from sim.anatomy import TUMOUR_LABEL
from sim.bodies.label_volume import build_volume_subject
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.errors import InputError
from sim.geometry.tetmesh import compute_dihedral_angles, compute_row_keys, find_boundary_faces

AXES = np.array([0.045, 0.055, 0.042])  # [m] half axes of the ellipsoid that stands for a brain
MIDDLE = np.array([0.004, -0.020, 0.012])
TUMOUR, RADIUS = MIDDLE + [0.014, 0.008, 0.016], 0.010
TURNED = Rotation.from_euler("xyz", [20, -15, 25], degrees=True).as_matrix()
AFFINES = {
    "straight": np.diag([1.2, 1.2, 1.2]),
    "negative": np.diag([-1.2, 1.2, 1.2]),
    "oblique": 1.2 * TURNED,
    "oblique and negative": TURNED @ np.diag([1.2, -1.4, 1.2]),
    "thick slices": np.diag([1.0, 1.0, 3.0]),
    "oblique thick slices": TURNED @ np.diag([3.0, 1.0, 1.0]),
}


def ellipsoid(points):
    return np.linalg.norm((points - MIDDLE) / AXES, axis=-1) < 1.0


def ball(points, middle=TUMOUR, radius=RADIUS):
    return np.linalg.norm(points - middle, axis=-1) < radius


def grid(axes):
    """Affine [mm] of a box round the brain, and the place (I, J, K, 3) [m] of each of its voxels."""
    reach = np.abs(np.linalg.inv(axes)) @ (1e3 * AXES.max() * np.ones(3)) + 4.0
    count = 2 * np.ceil(reach).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = axes
    affine[:3, 3] = 1e3 * MIDDLE - axes @ (0.5 * count)
    index = np.moveaxis(np.indices(count), 0, -1)
    return affine, 1e-3 * (index @ axes.T + affine[:3, 3])


def save(path, labels, affine):
    nibabel.save(nibabel.Nifti1Image(labels.astype(np.int16), affine), path)
    return path


def labelled(path, axes, tumour=ball):
    """A brain of labels 1 and 2 (its right half), and a tumour of 3 and 4 within it."""
    affine, places = grid(axes)
    brain, core = ellipsoid(places), tumour(places)
    labels = np.where(brain, 1 + (places[..., 0] > MIDDLE[0]), 0)
    labels[core] = 3 + (places[..., 0] > places[core, 0].mean())[core]
    return save(path, labels, affine), labels, affine


@pytest.mark.parametrize("kind", AFFINES)
def test_every_affine_gives_the_same_brain(tmp_path, kind):
    path, labels, affine = labelled(tmp_path / "labels.nii", AFFINES[kind])
    anatomy = make_anatomy(build_volume_subject(path, (1, 2), (3, 4)), MeshPlan(nodes=3000))
    mesh = anatomy.mesh
    assert abs(len(mesh.nodes) - 3000) <= 300
    assert compute_dihedral_angles(mesh.nodes, mesh.tets).min() > 10.0
    assert find_boundary_faces(mesh.tets).size and len(np.unique(mesh.tets)) == len(mesh.nodes)
    for triangles in (mesh.surface, anatomy.tumour_surface):
        edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        assert set(np.unique(compute_row_keys(edges), return_counts=True)[1]) == {2}
    voxel = 1e-9 * abs(np.linalg.det(affine[:3, :3]))
    assert mesh.volumes[mesh.region == TUMOUR_LABEL].sum() == pytest.approx((labels > 2).sum() * voxel, rel=0.02)
    # The frame is the volume's own: the ellipsoid that was sampled, in metres, whichever way its voxels lie.
    outer = mesh.nodes[np.unique(mesh.surface)]
    distance = np.abs(np.linalg.norm((outer - MIDDLE) / AXES, axis=1) - 1.0) * AXES.mean()
    mean, p95 = (4e-4, 1.3e-3) if "thick" in kind else (3e-4, 1e-3)
    assert distance.mean() < mean and np.percentile(distance, 95) < p95
    core = mesh.nodes[np.unique(anatomy.tumour_surface)]
    distance = np.abs(np.linalg.norm(core - TUMOUR, axis=1) - RADIUS)
    assert distance.mean() < mean and np.percentile(distance, 95) < p95
    # Opened over the tumour, held lowest.
    opening = mesh.nodes[anatomy.craniotomy].mean(axis=0) - MIDDLE
    assert opening @ (TUMOUR - MIDDLE) > 0.9 * np.linalg.norm(opening) * np.linalg.norm(TUMOUR - MIDDLE)
    assert mesh.nodes[anatomy.fixed.all(axis=1), 2].max() < MIDDLE[2] - 0.03


def test_craniotomy_is_never_below_the_tumour(tmp_path):
    low = MIDDLE - [0.0, 0.0, 0.024]
    path, _, _ = labelled(tmp_path / "l.nii", AFFINES["straight"], lambda points: ball(points, low))
    subject = build_volume_subject(path, (1, 2), (3, 4))
    assert subject.site[2] >= low[2]


def test_craniotomy_lies_over_reachable_cortex(tmp_path):
    """A fissure of half the brain's height lies at the tumour: its wall is nearest, and out of reach."""
    affine, places = grid(AFFINES["straight"])
    middle = MIDDLE + [0.012, 0.0, 0.012]
    fissure = (np.abs(places[..., 0] - MIDDLE[0] + 0.001) < 0.0025) & (places[..., 2] > MIDDLE[2])
    labels = np.where(ball(places, middle, 0.007), 3, ellipsoid(places) & ~fissure)
    subject = build_volume_subject(save(tmp_path / "l.nii", labels, affine), (1,), (3,))
    nearest = subject.cortex[np.linalg.norm(subject.cortex - middle, axis=1).argmin()]
    assert np.linalg.norm((nearest - MIDDLE) / AXES) < 0.5 and not subject.notes
    assert np.linalg.norm((subject.site - MIDDLE) / AXES) > 0.85
    assert np.linalg.norm(subject.site - middle) < 0.035


@pytest.mark.parametrize(
    ("brain", "tumour", "reason"),
    [
        ((1, 7), (3,), "has no label 7. Choose from 1, 2, 3, 4"),
        ((1, 2), (2, 3), "label 2 is named by --brain and by --tumour"),
        ((0, 1), (3,), "background"),
        ((), (3,), "at least one label"),
    ],
)
def test_invalid_label_selection_is_rejected(tmp_path, brain, tumour, reason):
    path, _, _ = labelled(tmp_path / "l.nii", AFFINES["thick slices"])
    with pytest.raises(InputError, match=reason):
        build_volume_subject(path, brain, tumour)


def test_unknown_labels_are_named_and_tumour_kept(tmp_path):
    """Unnamed oedema, 5, is the brain's upper half; in the lower one is a small piece of the tumour."""
    affine, places = grid(AFFINES["thick slices"])
    labels = np.where(ellipsoid(places), np.where(places[..., 2] > MIDDLE[2], 5, 1), 0)
    labels[ball(places) | ball(places, MIDDLE - [0.018, 0.0, 0.014], 0.006)] = 3
    path = save(tmp_path / "l.nii", labels, affine)
    with pytest.raises(InputError, match=r"4\.\d+ of 5\.\d+ ml of the tumour lie outside the brain"):
        build_volume_subject(path, (1,), (3,))
    assert build_volume_subject(path, (1, 5), (3,)).notes == ()
    labels[ball(places, radius=0.004)] = 2
    found = build_volume_subject(save(tmp_path / "l.nii", labels, affine), (1, 5), (3,))
    assert found.notes[0] == "neither brain nor tumour: what is labelled 2" and "of holes" in found.notes[1]


def test_invalid_label_volumes_are_rejected_with_reason(tmp_path):
    affine, places = grid(AFFINES["thick slices"])
    labels = ellipsoid(places).astype(np.int16)
    with_tumour = np.where(ball(places), 3, labels)

    def refused(name, values, reason, used=affine):
        path = tmp_path / name
        nibabel.save(nibabel.Nifti1Image(values, used), path)
        with pytest.raises(InputError, match=reason):
            build_volume_subject(path, (1,), (3,))

    outside = labels.copy()
    outside[:3, :3, :3] = 3
    not_finite = with_tumour.astype(np.float32)
    not_finite[0, 0, 0] = np.nan
    refused("outside.nii.gz", outside, "outside the brain")
    refused("fractions.nii.gz", (0.5 * with_tumour).astype(np.float32), "fractions")
    refused("nan.nii.gz", not_finite, "not finite")
    refused("slice.nii.gz", with_tumour[:, :, 20], "not one volume")
    refused("series.nii.gz", np.stack([with_tumour] * 2, axis=3), "not one volume")
    refused("colours.nii.gz", np.zeros((9, 9, 9), [("R", "u1"), ("G", "u1"), ("B", "u1")]), "colours")
    refused("empty.nii.gz", np.zeros_like(labels), "every voxel is 0")
    refused("coarse.nii.gz", with_tumour, "voxels measure", used=np.diag([8.0, 8.0, 8.0, 1.0]))
    refused("small.nii.gz", with_tumour, "make a brain of", used=np.diag([0.1, 0.1, 0.3, 1.0]))
    few = labels.copy()
    few[tuple(np.array(few.shape) // 2)] = 3
    refused("few.nii.gz", few, "has 1 voxels")


def test_files_that_are_not_volumes_are_rejected_by_name(tmp_path):
    (tmp_path / "folder.nii").mkdir()
    (tmp_path / "text.nii").write_text("not a volume" * 99)
    (tmp_path / "text.nii.gz").write_text("not compressed")
    (tmp_path / "text.mgz").write_text("")
    (tmp_path / "text.img").write_text("")
    affine, places = grid(AFFINES["thick slices"])
    whole = save(tmp_path / "whole.nii.gz", ellipsoid(places), affine).read_bytes()
    (tmp_path / "half.nii.gz").write_bytes(whole[: len(whole) // 2])
    for name, reason in (
        ("missing.nii.gz", "no such file"),
        ("folder.nii", "is a folder"),
        ("text.nii", "cannot be read as NIfTI"),
        ("text.nii.gz", "cannot be read as NIfTI"),
        ("half.nii.gz", "cannot be read as NIfTI"),
        ("text.mgz", "cannot be read as a FreeSurfer volume"),
        ("text.img", "unsupported file type; expected .nii"),
    ):
        with pytest.raises(InputError, match=reason) as caught:
            build_volume_subject(tmp_path / name, (1,), (3,))
        assert name in str(caught.value)


@pytest.mark.parametrize(("apart", "said"), [(0.5, False), (30.0, True)])
def test_contradicting_forms_are_noted_and_sform_is_used(tmp_path, apart, said):
    affine, places = grid(AFFINES["oblique and negative"])
    labels = np.where(ball(places), 3, ellipsoid(places)).astype(np.int16)
    image = nibabel.Nifti1Image(labels, affine)
    moved = affine.copy()
    moved[0, 3] += apart
    image.set_qform(moved, 1)
    image.set_sform(affine, 1)
    nibabel.save(image, tmp_path / "l.nii")
    subject = build_volume_subject(tmp_path / "l.nii", (1,), (3,))
    assert any("30 mm apart: the sform is taken" in note for note in subject.notes) == said
    assert np.linalg.norm(subject.interface.mean(axis=0) - TUMOUR) < 1e-3


def test_invalid_qform_does_not_affect_valid_sform(tmp_path):
    affine, places = grid(AFFINES["straight"])
    image = nibabel.Nifti1Image(np.where(ball(places), 3, ellipsoid(places)).astype(np.int16), affine)
    image.set_qform(affine, 1)
    image.header["quatern_b"] = 3.0
    nibabel.save(image, tmp_path / "l.nii")
    assert build_volume_subject(tmp_path / "l.nii", (1,), (3,)).notes == ()


def test_brain_cut_by_the_volume_border_is_noted(tmp_path):
    affine, places = grid(AFFINES["straight"])
    labels = np.where(ball(places), 3, ellipsoid(places))
    whole = build_volume_subject(save(tmp_path / "whole.nii", labels, affine), (1,), (3,))
    assert whole.notes == ()
    plane = labels.shape[2] // 2 + 18
    cut = build_volume_subject(save(tmp_path / "cut.nii", labels[..., :plane], affine), (1,), (3,))
    assert any(f"{(labels[..., plane - 1] > 0).sum()} voxels of the brain lie on" in note for note in cut.notes)


@pytest.mark.parametrize(("unit", "per_millimetre"), [("meter", 1e-3), ("micron", 1e3), ("unknown", 1.0)])
def test_brain_is_independent_of_length_unit_of_the_file(tmp_path, unit, per_millimetre):
    affine, places = grid(AFFINES["thick slices"])
    labels = np.where(ball(places), 3, ellipsoid(places)).astype(np.int16)
    image = nibabel.Nifti1Image(labels, np.diag([*[per_millimetre] * 3, 1.0]) @ affine)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / "other.nii")
    here = build_volume_subject(save(tmp_path / "mm.nii", labels, affine), (1,), (3,))
    there = build_volume_subject(tmp_path / "other.nii", (1,), (3,))
    assert there.tumour_volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)
    for name in ("site", "cortex", "interface", "tumour_volume"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-5, atol=1e-8)
    points = MIDDLE + AXES * np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    np.testing.assert_allclose(there.brain(points), here.brain(points), atol=1e-7)


def test_intensities_are_read_by_their_own_affine(tmp_path):
    """One bright voxel on a grid that is rotated and finer along one axis than the labels'."""
    path, labels, _ = labelled(tmp_path / "labels.nii", AFFINES["thick slices"])
    affine, places = grid(AFFINES["oblique and negative"])
    grey = np.full(places.shape[:3], 20.0, np.float32)
    bright = tuple(np.array(grey.shape) // 2 + [9, -5, 7])
    grey[bright] = 100.0
    assert grey.shape != labels.shape
    nibabel.save(nibabel.Nifti1Image(grey, affine), tmp_path / "t1.nii")
    subject = build_volume_subject(path, (1, 2), (3, 4), tmp_path / "t1.nii")
    beside = places[bright] + 1e-3 * np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, -4.0, 0.0], [0.0, 0.0, 4.0]])
    np.testing.assert_allclose(255.0 * subject.intensity.interpolate(beside), [100.0, 20.0, 20.0, 20.0], rtol=1e-3)


def with_plates(path, count):
    """A tumour of 8 mm, and round it `count` plates of 8 mm, a voxel thick, that it does not touch."""
    affine, places = grid(AFFINES["straight"])
    labels = np.where(ball(places, radius=0.008), 3, ellipsoid(places))
    for turn in np.linspace(0.0, 2.0 * np.pi, count, endpoint=False):
        middle = MIDDLE + 0.026 * np.array([np.cos(turn), np.sin(turn), -0.3])
        labels[ball(places, middle, 0.004) & (np.abs(places - middle)[..., 2] <= 0.0006)] = 3
    return save(path, labels, affine)


def test_lost_pieces_are_named_and_others_keep_volume(tmp_path, capsys):
    path = with_plates(tmp_path / "l.nii", 1)
    words = ["anatomy", "--labels", str(path), "--brain", "1", "--tumour", "3", "--nodes", "3000", "--json"]
    assert main([*words, "--craniotomy", "30", "--out", str(tmp_path / "a.vtu")]) == 0
    said = capsys.readouterr()
    summary = json.loads(said.out)
    lost = [piece["ml"] for piece in summary["tumour_pieces"] if piece["lost"]]
    assert len(lost) == 1 and not summary["tumour_pieces"][0]["lost"]
    assert f"does not hold 1 of the tumour's 2 pieces, {sum(lost):.2g} ml in all" in said.err
    volume = summary["tumour_pieces"][0]["ml"]
    assert summary["tumour_ml"] == pytest.approx(volume, rel=0.01) and sum(lost) > 0.03 * volume
