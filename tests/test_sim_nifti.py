"""NIfTI files of other programs: unusual compression, rounding, or missing orientation."""

import struct
from contextlib import nullcontext

import nibabel
import numpy as np
import pytest
from test_sim_label_volume import AFFINES, ball, ellipsoid, grid

from sim.bodies.label_map import read_labels
from sim.bodies.label_volume import build_volume_subject
from sim.errors import InputError


@pytest.mark.parametrize(
    ("signs", "swapped"), [((-1, 1, 1), True), ((-1, -1, 1), True), ((-1, 1, -1), True), ((1, -1, -1), False)]
)
def test_forms_that_swap_sides_are_noted(tmp_path, signs, swapped):
    affine, places = grid(AFFINES["straight"])
    image = nibabel.Nifti1Image(np.where(ball(places), 3, ellipsoid(places)).astype(np.int16), affine)
    image.set_qform(np.diag([*signs, 1.0]) @ affine, 1)
    image.set_sform(affine, 1)
    nibabel.save(image, tmp_path / "l.nii")
    note = build_volume_subject(tmp_path / "l.nii", (1,), (3,)).notes[0]
    assert ("left and right are swapped in one of them" in note) == swapped
    assert "sform is taken" in note.lower()


def test_header_without_voxel_size_is_rejected_without_a_log(tmp_path, capfd):
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


def test_unsupported_voxel_type_is_rejected(tmp_path):
    raw = bytearray(nibabel.Nifti1Image(np.ones((4, 4, 4), np.int16), np.eye(4)).to_bytes())
    struct.pack_into("<hh", raw, 70, 1536, 128)
    (tmp_path / "l.nii").write_bytes(raw)
    with pytest.raises(InputError, match=r"nibabel reports `data code 1536 not supported`\. Give one"):
        read_labels(tmp_path / "l.nii")
