"""Warps of images and label maps as SimpleITK carries them."""

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from warped import BLOBS, GRIDS, LPS, MAPPED, WIDTH, bump, places

from sim.geometry.locate import locate
from sim.geometry.tetmesh import compute_signed_volumes


@pytest.fixture(scope="module")
def middles(box):
    """Where the finite elements take the middles of the spots (5, 3) [m], by themselves: no grid has a part in it."""
    moved = bump(box.mesh.nodes)
    offsets = np.random.default_rng(0).normal(0.0, WIDTH, (20_000, 3))
    found = []
    for blob in BLOBS:
        at = locate(box.mesh, np.concatenate([blob + offsets, blob - offsets]))
        now = at.read((box.mesh.nodes + moved)[None])[0]
        rest = compute_signed_volumes(box.mesh.nodes, at.vertices)
        found.append(
            np.average(now, axis=0, weights=compute_signed_volumes(box.mesh.nodes + moved, at.vertices) / rest)
        )
    return np.array(found)


def centroids(image, near):
    """Middles (5, 3) [m, RAS] of the brightness of SimpleITK's image within 8 mm of five points (5, 3)."""
    values = np.moveaxis(sitk.GetArrayFromImage(image), [0, 1, 2], [2, 1, 0]).astype(float)
    directions = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    points = 1e-3 * LPS * (np.moveaxis(np.indices(values.shape), 0, -1) @ directions.T + image.GetOrigin())
    found = []
    for point in near:
        close = np.linalg.norm(points - point, axis=-1) < 8e-3
        found.append(np.average(points[close], axis=0, weights=values[close]))
    return np.array(found)


@pytest.mark.parametrize("kind", GRIDS)
def test_simpleitk_landmarks_match_fem(kind, warp_folder, warp_out, middles):
    field = sitk.ReadImage(str(warp_out / "field_resampling.nii.gz"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    scan = sitk.ReadImage(str(warp_folder / f"{kind}.nii.gz"))
    assert np.abs(centroids(scan, BLOBS) - BLOBS).max() < 0.03e-3
    itk = sitk.Resample(scan, scan, transform, sitk.sitkLinear, 0.0)
    error = np.linalg.norm(centroids(itk, middles) - middles, axis=1)
    assert error.max() < 0.05e-3, 1e3 * error
    ours = sitk.ReadImage(str(warp_out / f"{kind}_deformed.nii.gz"))
    assert np.linalg.norm(centroids(ours, middles) - middles, axis=1).max() < 0.05e-3
    apart = np.abs(sitk.GetArrayFromImage(ours) - sitk.GetArrayFromImage(itk))
    assert apart.max() < 0.5  # of 1000
    assert np.linalg.norm(middles - BLOBS, axis=1).min() > 0.4e-3


@pytest.mark.parametrize("kind", MAPPED)
def test_label_maps_keep_their_labels_type_and_place(kind, warp_folder, warp_out, middles):
    before, after = (
        nibabel.load(warp_folder / f"{kind}_labels.nii.gz"),
        nibabel.load(warp_out / f"{kind}_labels_deformed.nii.gz"),
    )
    assert after.get_data_dtype() == np.uint8 and np.array_equal(before.affine, after.affine)
    values = np.asarray(after.dataobj)
    assert set(np.unique(values)) == set(range(6))
    points = places(after.affine, values.shape)
    for label, middle in enumerate(middles, 1):
        assert np.linalg.norm(points[values == label].mean(axis=0) - middle) < 0.8e-3 * max(
            GRIDS[kind][1]
        )  # of whole voxels


def test_points_go_the_way_that_tissue_goes(box, warp_out):
    """ITK's own forward field, through the NRRD, moves points: no sign and no axis is mixed up."""
    field = sitk.ReadImage(str(warp_out / "field_modeling.nrrd"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    now = 1e-3 * LPS * np.array([transform.TransformPoint((1e3 * blob * LPS).tolist()) for blob in BLOBS])
    truth = locate(box.mesh, BLOBS).read((box.mesh.nodes + bump(box.mesh.nodes))[None])[0]
    assert np.abs(now - truth).max() < 0.05e-3
