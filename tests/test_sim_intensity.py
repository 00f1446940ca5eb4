"""Intensities of an image with a mesh: written, read, cropped and sampled in the mesh's frame."""

import nibabel
import numpy as np
import pytest

from sim.bodies.intensity import GreyWindow, Intensity, read_intensity, to_intensity_path, write_intensity
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh

from .boxes import box

AFFINE = np.array([[-1e-3, 2e-4, 0, 0.03], [2e-4, 1e-3, 0, -0.02], [0, 0, 2e-3, 0.01], [0, 0, 0, 1.0]])


def ramp():
    index = np.moveaxis(np.indices((40, 50, 30)), 0, -1).astype(float)
    return Intensity((index @ [2.0, 1.0, 3.0]).astype(np.float32), AFFINE)


def places(index):
    return np.asarray(index) @ AFFINE[:3, :3].T + AFFINE[:3, 3]


def test_intensity_sampling_is_trilinear_and_zero_outside():
    index = np.array([[3.25, 7.5, 11.75], [20.0, 30.0, 10.0], [38.9, 48.9, 28.9]])
    np.testing.assert_allclose(ramp().interpolate(places(index)), index @ [2.0, 1.0, 3.0] / 255.0, rtol=1e-6)
    assert ramp().interpolate(places([[-5.0, 0.0, 0.0]]))[0] == 0.0


def brain():
    """A mesh of tetrahedra in the volume, voxels 8 to 31 along the first axis, and so on."""
    mesh = box((6, 6, 6), 1.0)
    return TetMesh(places(mesh.nodes * [23.0, 33.0, 20.0] + [8.0, 8.0, 5.0]), mesh.tets[:, [0, 2, 1, 3]], mesh.region)


def test_cropped_intensity_round_trip_keeps_values_and_affine(tmp_path):
    points = places([[18.0, 22.0, 14.0], [22.0, 28.0, 16.0]])
    crop = ramp().crop(points, brain())
    assert crop.values.dtype == np.uint8 and np.prod(crop.values.shape) < 40 * 50 * 30
    path = to_intensity_path(tmp_path / "mesh.vtu")
    assert path.name == "mesh.t1.nii.gz"
    write_intensity(path, crop)
    again = read_intensity(path)
    np.testing.assert_array_equal(again.values, crop.values)
    np.testing.assert_allclose(again.affine, crop.affine, rtol=1e-6, atol=1e-9)
    # Grey levels go with the volume's own, and the brain's stay apart from black and from white.
    after = again.interpolate(points)
    assert 0.2 < after[0] < after[1] < 0.8
    np.testing.assert_allclose(again.interpolate(points.mean(axis=0)[None]), after.mean(), rtol=0.01)
    # Other programs read millimetres.
    np.testing.assert_allclose(nibabel.load(path).affine[:3], 1e3 * crop.affine[:3], rtol=1e-6, atol=1e-6)
    assert sorted(tmp_path.iterdir()) == [path]


def test_intensity_crop_reaches_15_mm_beyond_the_points():
    """Voxels of 1 mm: one point has 15 to each side, and the two of a trilinear value; fewer at the border."""
    cube = Intensity(np.ones((60, 60, 60), np.float32), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    crop = cube.crop(np.array([[0.0302, 0.0302, 0.0502]]), box((2, 2, 2), 0.059))
    assert crop.values.shape == (32, 32, 25)
    np.testing.assert_allclose(crop.affine[:3, 3], [0.015, 0.015, 0.035], atol=1e-12)


def waves():
    """Grey values that go up and down everywhere, with a little noise."""
    noise = np.random.default_rng(0).normal(0.0, 2.0, (40, 50, 30))
    return 100.0 + 30.0 * np.sin(np.indices((40, 50, 30)).sum(axis=0) / 3.0) + noise


def test_intensity_window_ignores_scale_and_offset():
    grey = waves()
    usual = Intensity(grey, AFFINE).apply_window(brain())
    inside = np.s_[8:32, 8:42, 5:26]
    assert np.percentile(usual[inside], [5, 90]) == pytest.approx([0.3, 0.97], abs=0.05)
    for other in (37.5 * grey, (grey - grey.mean()) / grey.std(), grey - 1e4):
        np.testing.assert_allclose(Intensity(other, AFFINE).apply_window(brain()), usual, atol=1e-4)
    coarse = np.rint(255 * (grey - grey.min()) / np.ptp(grey)).astype(np.uint8)
    np.testing.assert_allclose(Intensity(coarse, AFFINE).apply_window(brain()), usual, atol=0.02)


def test_non_finite_voxels_do_not_change_the_window():
    grey = waves()
    usual = Intensity(grey, AFFINE).apply_window(brain())
    wrong = np.random.default_rng(1).random(grey.shape) < 0.01
    for value in (np.nan, np.inf, 1e6):
        found = Intensity(np.where(wrong, value, grey), AFFINE).apply_window(brain())
        np.testing.assert_allclose(found[~wrong], usual[~wrong], atol=0.02)
        assert np.ptp(found[wrong]) == 0.0 and 0.3 < found[wrong][0] < 0.97
    assert (
        Intensity(np.full(grey.shape, -7.0), AFFINE).apply_window(brain()) == np.float32(GreyWindow().flat_grey)
    ).all()


def test_intensity_without_cover_or_finite_values_is_rejected(tmp_path):
    with pytest.raises(InputError, match="does not cover"):
        ramp().crop(places([[400.0, 0.0, 0.0]]), brain())
    with pytest.raises(InputError, match="no finite values in the brain"):
        Intensity(np.full((40, 50, 30), np.nan), AFFINE).crop(places([[20.0, 20.0, 10.0]]), brain())
    with pytest.raises(InputError, match="no such file"):
        read_intensity(tmp_path / "none.nii.gz")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="folder cannot be created"):
        write_intensity(tmp_path / "file" / "a.t1.nii.gz", ramp())
