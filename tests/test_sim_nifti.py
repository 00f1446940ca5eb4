"""NIfTI files as other programs leave them: packed otherwise than named, rounded, or without an orientation."""

import bz2
import gzip
import lzma
import struct
import zipfile
from contextlib import nullcontext

import nibabel
import numpy as np
import pytest
from test_sim_label_volume import AFFINES, ball, ellipsoid, grid

from sim.bodies.head_masks import Sources, read_head_masks
from sim.bodies.label_map import read_labels
from sim.bodies.label_volume import build_masked_subject, build_volume_subject
from sim.bodies.voxels import Voxels
from sim.errors import InputError


def test_volume_without_orientation_needs_axes(tmp_path):
    _, places = grid(AFFINES["thick slices"])
    labels = np.where(ball(places), 3, ellipsoid(places)).astype(np.int16)
    path = tmp_path / "l.nii"
    nibabel.save(nibabel.Nifti1Image(labels, None), path)
    with pytest.raises(InputError, match=r"neither sform nor qform, so its left side is unknown.* --axes RAS"):
        build_volume_subject(path, (1,), (3,))
    with pytest.raises(InputError, match="axes 'RAR' are no directions"):
        read_labels(path, Voxels(axes="RAR"))
    where = {}
    for axes in ("RAS", "LPS", "PIR"):
        masks = read_head_masks(Sources(path, (1,), (3,), axes=axes))
        where[axes] = build_masked_subject(masks, path).pieces[0].centre  # the scan's axes are the same
    np.testing.assert_allclose(where["LPS"], where["RAS"] * [-1.0, -1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(where["PIR"], (where["RAS"] * [-1.0, -1.0, 1.0])[[2, 0, 1]], atol=1e-6)


@pytest.mark.parametrize(
    ("signs", "swapped"), [((-1, 1, 1), True), ((-1, -1, 1), True), ((-1, 1, -1), True), ((1, -1, -1), False)]
)
def test_forms_that_swap_sides_say_left_and_right(tmp_path, signs, swapped):
    affine, places = grid(AFFINES["straight"])
    image = nibabel.Nifti1Image(np.where(ball(places), 3, ellipsoid(places)).astype(np.int16), affine)
    image.set_qform(np.diag([*signs, 1.0]) @ affine, 1)
    image.set_sform(affine, 1)
    nibabel.save(image, tmp_path / "l.nii")
    note = build_volume_subject(tmp_path / "l.nii", (1,), (3,)).notes[0]
    assert ("left and right are swapped in one of them" in note) == swapped
    assert "sform is taken" in note.lower()


@pytest.mark.parametrize("form", ["set_sform", "set_qform"])
def test_axes_of_a_file_with_a_place_are_ignored_with_a_note(tmp_path, form):
    image = nibabel.Nifti1Image(np.ones((4, 4, 4), np.int16), None)
    getattr(image, form)(np.eye(4), 1)
    nibabel.save(image, tmp_path / "l.nii")
    read = read_labels(tmp_path / "l.nii", Voxels(axes="LPS"))
    assert read.notes == ("its own orientation is used: axes LPS are ignored",)
    np.testing.assert_array_equal(read.affine[:3, :3], 1e-3 * np.eye(3))
    nibabel.save(nibabel.MGHImage(np.ones((4, 4, 4), np.int16), np.eye(4)), tmp_path / "l.mgz")
    assert read_labels(tmp_path / "l.mgz", Voxels(axes="LPS")).notes == read.notes


@pytest.mark.parametrize(
    ("name", "pack"),
    [("l.nii.gz", bytes), ("l.nii", gzip.compress), ("l.nii.gz", bz2.compress), ("l.nii", lzma.compress)],
)
def test_volume_is_unpacked_by_its_content(tmp_path, name, pack):
    affine, places = grid(AFFINES["straight"])
    labels = np.where(ball(places), 3, ellipsoid(places)).astype(np.int16)
    nibabel.save(nibabel.Nifti1Image(labels, affine), tmp_path / "whole.nii")
    (tmp_path / name).write_bytes(pack((tmp_path / "whole.nii").read_bytes()))
    np.testing.assert_array_equal(read_labels(tmp_path / name).layers[..., 0], labels)
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        archive.write(tmp_path / "whole.nii")
    with pytest.raises(InputError, match=r"is a ZIP archive: unpack it"):
        read_labels(tmp_path / name)


def test_labels_with_round_off_are_rounded_with_a_note(tmp_path):
    affine, places = grid(AFFINES["straight"])
    labels = np.where(ball(places), 3, ellipsoid(places)).astype(np.int16)
    for error, fits in ((2e-5, True), (2e-3, False)):
        nibabel.save(nibabel.Nifti1Image((labels * (1.0 - error / 3)).astype(np.float32), affine), tmp_path / "l.nii")
        with nullcontext() if fits else pytest.raises(InputError, match="holds fractions"):
            found = read_labels(tmp_path / "l.nii")
            np.testing.assert_array_equal(found.layers[..., 0], labels)
            assert found.notes == ("its labels are rounded by up to 2e-05",)


def test_header_without_voxel_size_says_so_without_a_log(tmp_path, capfd):
    affine, places = grid(AFFINES["straight"])
    image = nibabel.Nifti1Image(np.where(ball(places), 3, ellipsoid(places)).astype(np.int16), affine)
    image.set_qform(affine, 1)
    for code, reason in ((1, None), (0, r"its voxel size is \[0\. 0\. 0\.\] \(pixdim\)")):
        image.set_sform(affine, code)
        raw = bytearray(image.to_bytes())
        raw[80:92] = bytes(12)
        (tmp_path / "l.nii").write_bytes(raw)
        with nullcontext() if reason is None else pytest.raises(InputError, match=reason):
            read_labels(tmp_path / "l.nii")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
def test_overlong_quaternion_is_rounded_or_reported(tmp_path, kind):
    turn = np.diag([1.0, -1.0, -1.0])
    image = kind(np.ones((4, 4, 4), np.int16), None)
    image.set_qform(np.block([[turn, np.zeros((3, 1))], [np.zeros(3), 1.0]]), 1)
    place, number = (256, "<f") if kind is nibabel.Nifti1Image else (352, "<d")
    for length, fits in ((1.0002, True), (1.2, False)):
        raw = bytearray(image.to_bytes())
        struct.pack_into(number, raw, place, length)
        (tmp_path / "l.nii").write_bytes(raw)
        with nullcontext() if fits else pytest.raises(InputError, match=r"quaternion of length 1\.2, .* must be 1"):
            np.testing.assert_allclose(read_labels(tmp_path / "l.nii").affine[:3, :3], 1e-3 * turn)


def test_values_of_an_unread_type_are_reported(tmp_path):
    raw = bytearray(nibabel.Nifti1Image(np.ones((4, 4, 4), np.int16), np.eye(4)).to_bytes())
    struct.pack_into("<hh", raw, 70, 1536, 128)
    (tmp_path / "l.nii").write_bytes(raw)
    with pytest.raises(InputError, match=r"nibabel reports `data code 1536 not supported`\. Give one"):
        read_labels(tmp_path / "l.nii")
