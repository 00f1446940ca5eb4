"""Labels of a file: rounded, and its axes; each with a note."""

from contextlib import nullcontext

import nibabel
import numpy as np
import pytest
from test_sim_label_volume import AFFINES, ball, ellipsoid, grid

from sim.bodies.label_map import read_labels
from sim.bodies.voxels import VoxelSpec
from sim.errors import InputError


@pytest.mark.parametrize("form", ["set_sform", "set_qform"])
def test_given_axes_of_oriented_file_are_ignored_with_note(tmp_path, form):
    image = nibabel.Nifti1Image(np.ones((4, 4, 4), np.int16), None)
    getattr(image, form)(np.eye(4), 1)
    nibabel.save(image, tmp_path / "l.nii")
    read = read_labels(tmp_path / "l.nii", VoxelSpec(axes="LPS"))
    assert read.notes == ("its own orientation is used: axes LPS are ignored",)
    np.testing.assert_array_equal(read.affine[:3, :3], 1e-3 * np.eye(3))
    nibabel.save(nibabel.MGHImage(np.ones((4, 4, 4), np.int16), np.eye(4)), tmp_path / "l.mgz")
    assert read_labels(tmp_path / "l.mgz", VoxelSpec(axes="LPS")).notes == read.notes


def test_labels_with_round_off_are_rounded_with_a_note(tmp_path):
    affine, places = grid(AFFINES["straight"])
    labels = np.where(ball(places), 3, ellipsoid(places)).astype(np.int16)
    for error, fits in ((2e-5, True), (2e-3, False)):
        nibabel.save(nibabel.Nifti1Image((labels * (1.0 - error / 3)).astype(np.float32), affine), tmp_path / "l.nii")
        with nullcontext() if fits else pytest.raises(InputError, match="holds fractions"):
            found = read_labels(tmp_path / "l.nii")
            np.testing.assert_array_equal(found.layers[..., 0], labels)
            assert found.notes == ("its labels are rounded by up to 2e-05",)
