"""Grey values beside a mesh: written, read, cropped and sampled in the mesh's frame."""

import nibabel
import numpy as np
import pytest

from sim.bodies.intensity import Intensity, read_intensity, sidecar, write_intensity
from sim.errors import InputError

AFFINE = np.array([[-1e-3, 2e-4, 0, 0.03], [2e-4, 1e-3, 0, -0.02], [0, 0, 2e-3, 0.01], [0, 0, 0, 1.0]])


def ramp():
    index = np.moveaxis(np.indices((40, 50, 30)), 0, -1).astype(float)
    return Intensity((index @ [2.0, 1.0, 3.0]).astype(np.float32), AFFINE)


def places(index):
    return np.asarray(index) @ AFFINE[:3, :3].T + AFFINE[:3, 3]


def test_sampling_is_trilinear_in_metres_and_zero_outside():
    index = np.array([[3.25, 7.5, 11.75], [20.0, 30.0, 10.0], [38.9, 48.9, 28.9]])
    np.testing.assert_allclose(ramp().at(places(index)), index @ [2.0, 1.0, 3.0] / 255.0, rtol=1e-6)
    assert ramp().at(places([[-5.0, 0.0, 0.0]]))[0] == 0.0


def test_the_crop_keeps_the_place_and_scales_to_white(tmp_path):
    points = places([[18.0, 22.0, 14.0], [22.0, 28.0, 16.0]])
    crop = ramp().around(points)
    assert crop.values.dtype == np.uint8 and crop.values.max() == 255
    assert np.prod(crop.values.shape) < 40 * 50 * 30
    ratio = ramp().at(points) / crop.at(points)
    assert np.ptp(ratio) < 0.02 * ratio.mean()
    path = sidecar(tmp_path / "mesh.vtu")
    assert path.name == "mesh.t1.nii.gz"
    write_intensity(path, crop)
    again = read_intensity(path)
    np.testing.assert_array_equal(again.values, crop.values)
    np.testing.assert_allclose(again.affine, crop.affine, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(again.at(points), crop.at(points), rtol=1e-4)
    # Other programs read millimetres.
    np.testing.assert_allclose(nibabel.load(path).affine[:3], 1e3 * crop.affine[:3], rtol=1e-6, atol=1e-6)
    assert sorted(tmp_path.iterdir()) == [path]


def test_the_crop_reaches_15_mm_beyond_the_box_round_the_points():
    """Voxels of 1 mm: one point has 15 to each side, the two of a trilinear value, and no more; less at the border."""
    cube = Intensity(np.ones((60, 60, 60), np.float32), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    crop = cube.around(np.array([[0.0302, 0.0302, 0.0502]]))
    assert crop.values.shape == (32, 32, 25)
    np.testing.assert_allclose(crop.affine[:3, 3], [0.015, 0.015, 0.035], atol=1e-12)


def test_a_volume_elsewhere_or_black_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not cover"):
        ramp().around(places([[400.0, 0.0, 0.0]]))
    with pytest.raises(InputError, match="black"):
        Intensity(np.zeros((40, 50, 30), np.float32), AFFINE).around(places([[20.0, 20.0, 10.0]]))
    with pytest.raises(InputError, match="no such file"):
        read_intensity(tmp_path / "none.nii.gz")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="folder cannot be made"):
        write_intensity(tmp_path / "file" / "a.t1.nii.gz", ramp())
