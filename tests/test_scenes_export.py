"""Files that a warp writes: fields without folds, markups, checksums and a README."""

import hashlib
import json

import SimpleITK as sitk  # noqa: N813


def test_itk_jacobian_of_exported_fields_is_positive(warp_out):
    for name in ("field_resampling.nii.gz", "field_modeling.nrrd"):
        field = sitk.ReadImage(str(warp_out / name), sitk.sitkVectorFloat64)
        least = sitk.GetArrayFromImage(sitk.DisplacementFieldJacobianDeterminant(field)).min()
        said = json.loads((warp_out / "warp.json").read_text())["least_jacobian"]
        assert least >= min(said.values()) > 0.4


def test_markups_and_report_list_the_written_files(warp_out):
    landmarks = json.loads((warp_out / "landmarks.mrk.json").read_text())
    assert landmarks["@schema"].endswith("markups-schema-v1.0.3.json#")
    (markup,) = landmarks["markups"]
    assert markup["type"] == "Fiducial" and markup["coordinateSystem"] == "LPS"
    assert {point["positionStatus"] for point in markup["controlPoints"]} == {"defined"}
    assert [point["label"] for point in markup["controlPoints"]][:2] == ["tumour, in the scan", "tumour, now"]
    report = json.loads((warp_out / "warp.json").read_text())
    assert set(report["files"]) | {"warp.json"} == {path.name for path in warp_out.iterdir()}
    assert report["sha256"] == {n: hashlib.sha256((warp_out / n).read_bytes()).hexdigest() for n in report["files"]}
    text = (warp_out / "README.txt").read_text()
    assert "Not a medical device" in text and "RAS" in text and "nothing folds" in text
