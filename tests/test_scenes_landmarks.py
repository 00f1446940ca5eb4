"""Landmarks of a warp: points in tissue, or the nearest tissue of a hollow tumour."""

import json

import numpy as np
import SimpleITK as sitk  # noqa: N813
from warped import bump

from scenes.warp.landmarks import NEAREST, list_landmarks
from sim.geometry.locate import locate


def test_landmarks_are_tissue_points_moved_by_field(warp_out):
    field = sitk.ReadImage(str(warp_out / "field_modeling.nrrd"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    controls = json.loads((warp_out / "landmarks.mrk.json").read_text())["markups"][0]["controlPoints"]
    points = {point["label"]: np.array(point["position"]) for point in controls}
    stated = json.loads((warp_out / "warp.json").read_text())["grid_error_mm"]["landmarks_worst"]
    for name in ("tumour", "open cortex"):
        now = points[f"{name}, now"]
        carried = transform.TransformPoint(points[f"{name}, in the scan"].tolist())
        assert np.linalg.norm(carried - now) < stated + 0.05 and stated < 0.1
        assert np.linalg.norm(points[f"{name}, in the scan"] - now) > 1.0


def test_hollow_tumour_landmark_is_labelled_as_nearest_tissue(box):
    middles = box.mesh.nodes[box.mesh.tets].mean(axis=1)
    tumour = np.flatnonzero(box.mesh.region == 2)
    hollow = box.remove_elements(tumour[np.linalg.norm(middles[tumour] + [0.0, 0.0, 22e-3], axis=1) < 5e-3])
    moved = bump(box.mesh.nodes)
    nearest, cortex = list_landmarks(hollow, moved)
    assert nearest.name == NEAREST and cortex.name == "open cortex"
    np.testing.assert_allclose(
        nearest.deformed, nearest.rest + locate(hollow.mesh, nearest.rest[None]).interpolate(moved[None])[0, 0]
    )
