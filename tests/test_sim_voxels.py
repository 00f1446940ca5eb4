"""Volumes of files that are compressed, or without an orientation."""

import bz2
import gzip
import lzma
import zipfile

import nibabel
import numpy as np
import pytest
from test_sim_label_volume import AFFINES, ball, ellipsoid, grid

from sim.bodies.head_masks import MaskSources, read_head_masks
from sim.bodies.label_map import read_labels
from sim.bodies.label_volume import build_masked_subject, build_volume_subject
from sim.bodies.voxels import VoxelSpec
from sim.errors import InputError


def test_volume_without_orientation_requires_axes(tmp_path):
    _, places = grid(AFFINES["thick slices"])
    labels = np.where(ball(places), 3, ellipsoid(places)).astype(np.int16)
    path = tmp_path / "l.nii"
    nibabel.save(nibabel.Nifti1Image(labels, None), path)
    with pytest.raises(InputError, match=r"neither sform nor qform, so its left side is unknown.* --axes RAS"):
        build_volume_subject(path, (1,), (3,))
    with pytest.raises(InputError, match="axes 'RAR' are no directions"):
        read_labels(path, VoxelSpec(axes="RAR"))
    where = {}
    for axes in ("RAS", "LPS", "PIR"):
        masks = read_head_masks(MaskSources(path, (1,), (3,), axes=axes))
        where[axes] = build_masked_subject(masks, path).pieces[0].centre  # the scan's axes are the same
    np.testing.assert_allclose(where["LPS"], where["RAS"] * [-1.0, -1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(where["PIR"], (where["RAS"] * [-1.0, -1.0, 1.0])[[2, 0, 1]], atol=1e-6)


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
