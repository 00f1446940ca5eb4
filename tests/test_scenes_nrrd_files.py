"""NRRD files of a warp as pynrrd and slicerio read them."""

import json

import nibabel
import nrrd
import numpy as np
import slicerio
from warped import LPS, bump

from sim.geometry.tetmesh import compute_signed_volumes


def test_nrrd_and_nifti_headers_describe_fields_for_slicer(warp_out):
    values, header = nrrd.read(str(warp_out / "field_modeling.nrrd"))
    assert header["kinds"] == ["vector", "domain", "domain", "domain"] and header["space"] == "left-posterior-superior"
    assert header["displacement field type"] == "modeling" and header["intent_code"] == "1006"
    assert np.array_equal(header["measurement frame"], np.eye(3)) and values.shape[0] == 3
    field = nibabel.load(warp_out / "field_resampling.nii.gz")
    assert field.shape[3:] == (1, 3) and field.header.get_intent()[0] == "displacement vector"
    assert field.header["intent_code"] == 1006 and field.header.get_xyzt_units()[0] == "mm"
    assert field.get_data_dtype() == np.float32 and int(field.header["sform_code"]) and int(field.header["qform_code"])


def test_slicerio_reads_tumour_and_bound(box, warp_out):
    read = slicerio.read_segmentation(str(warp_out / "tumour.seg.nrrd"))
    tumour, shell = read["segments"]
    assert tumour["name"] == "tumour" and "95 %" in shell["name"]
    voxels, edge = read["voxels"], abs(read["ijkToLPS"][0, 0])
    now = box.mesh.nodes + bump(box.mesh.nodes)
    size = compute_signed_volumes(now, box.mesh.tets[box.mesh.region == 2]).sum()
    assert np.isclose((voxels == tumour["labelValue"]).sum() * (1e-3 * edge) ** 3, size, rtol=0.03)
    middle = np.argwhere(voxels == 1).mean(axis=0)
    where = (read["ijkToLPS"] @ [*middle, 1.0])[:3] * LPS
    controls = json.loads((warp_out / "landmarks.mrk.json").read_text())["markups"][0]["controlPoints"]
    (centroid,) = (point["position"] for point in controls if point["label"] == "centroid of the tumour now")
    assert np.linalg.norm(where - LPS * centroid) < 0.05
    bound = json.loads((warp_out / "warp.json").read_text())["bound_mm"]
    assert np.isclose(bound, 1e3 * np.sqrt(7.815 * 4e-6), rtol=1e-3)
    outer = np.argwhere(voxels > 0)
    inner = np.argwhere(voxels == 1)
    assert np.abs((inner.min(axis=0) - outer.min(axis=0)) * edge - bound).max() < 2 * edge
