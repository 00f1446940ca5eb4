"""A warp as others read it: SimpleITK, pynrrd, slicerio and trimesh; and what is refused."""

import hashlib
import json
import struct
from xml.etree import ElementTree

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import slicerio
import trimesh

from scenes.cli import main
from scenes.warp.landmarks import NEAREST, landmarks_of
from sim.bodies.meshfile import write_anatomy, write_mesh
from sim.geometry.locate import locate
from sim.geometry.tetmesh import signed_volumes

BLOBS = 1e-3 * np.array([[0, 2, -24], [13, 6, -13], [-14, 7, -12], [5, -14, -15], [-11, -9, -26]], float)
"""Middles of Gaussian spots in the body [m], and how wide they are [m]."""
WIDTH = 1.9e-3
TURN = np.array([[0.8660254, -0.4698463, 0.1710101], [0.5, 0.8137977, -0.2961981], [0.0, 0.3420201, 0.9396926]])
GRIDS = {
    "straight": (np.eye(3), (1.0, 1.0, 1.0)),
    "oblique": (TURN, (1.0, 1.0, 1.0)),
    "anisotropic": (TURN[[1, 2, 0]], (0.9, 1.1, 2.0)),
    "mirrored": (np.diag([-1.0, 1.0, 1.0]) @ TURN, (1.1, 1.0, 1.2)),
}
"""Directions of a volume's axes (columns, RAS), and the edges of its voxels [mm]."""
MAPPED = ("oblique", "mirrored")
"""Those with a label map, too."""
LPS = np.array([-1.0, -1.0, 1.0])


def bump(nodes):
    """A push of 5 mm on the top, which dies away to the held sides: (V, 3) [m]."""
    share = np.clip(1.0 - (np.linalg.norm(nodes[:, :2], axis=1) / 25e-3) ** 2, 0.0, 1.0)
    push = -5e-3 * share * np.clip(1.0 + nodes[:, 2] / 42e-3, 0.0, 1.0)
    return np.stack([-0.4 * push * nodes[:, 0] / 14e-3, 0.2 * push, push], axis=1)


def places(affine, shape):
    """Of the voxels (I, J, K, 3) [m, RAS]."""
    return 1e-3 * (np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3])


def volume(kind):
    """The affine [mm] and the shape of a grid that holds the body."""
    directions, edges = GRIDS[kind]
    shape = tuple(int(np.ceil(78 / edge)) for edge in edges)
    affine = np.eye(4)
    affine[:3, :3] = directions * edges
    affine[:3, 3] = [0.3, -0.4, -20.0] - affine[:3, :3] @ (0.5 * np.array(shape))
    return affine, shape


def spots(points):
    """Brightness (5, ...) at points (..., 3) [m], spot by spot."""
    return np.stack([np.exp(-((points - blob) ** 2).sum(axis=-1) / (2 * WIDTH**2)) for blob in BLOBS])


@pytest.fixture(scope="module")
def folder(tmp_path_factory, box):
    """An anatomy, its displacement, images on four grids with a label map each, and the warp of all."""
    folder = tmp_path_factory.mktemp("warp")
    write_anatomy(folder / "box.vtu", box)
    # 1e-6 I + 3e-6 u u' with u along (1, 2, 3): xx, yy, zz, xy, yz, xz; its largest eigenvalue is 4e-6.
    covariance = 1e-6 * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) + 3e-6 / 14.0 * np.array([1, 4, 9, 2, 6, 3])
    covariance = np.tile(covariance, (len(box.mesh.nodes), 1))
    deviation = np.full(len(box.mesh.nodes), 6e-6**0.5)
    data = {"displacement": bump(box.mesh.nodes), "deviation": deviation, "covariance": covariance}
    write_mesh(folder / "located.vtu", box.mesh, data)
    for kind in GRIDS:
        affine, shape = volume(kind)
        bright = spots(places(affine, shape))
        nibabel.save(
            nibabel.Nifti1Image((1e3 * bright.max(axis=0)).astype(np.float32), affine), folder / f"{kind}.nii.gz"
        )
        if kind not in MAPPED:
            continue
        labels = np.where(bright.max(axis=0) > 0.3, 1 + bright.argmax(axis=0), 0).astype(np.uint8)
        nibabel.save(nibabel.Nifti1Image(labels, affine), folder / f"{kind}_labels.nii.gz")
    images = [str(folder / f"{kind}.nii.gz") for kind in GRIDS]
    labels = [str(folder / f"{kind}_labels.nii.gz") for kind in MAPPED]
    words = ["--located", str(folder / "located.vtu"), "--image", *images, "--labels", *labels]
    assert main(["warp", str(folder / "box.vtu"), *words, "--out", str(folder / "out")]) == 0
    return folder


@pytest.fixture(scope="module")
def out(folder):
    return folder / "out"


@pytest.fixture(scope="module")
def middles(box):
    """Where the finite elements take the middles of the spots (5, 3) [m], by themselves: no grid has a part in it."""
    moved = bump(box.mesh.nodes)
    offsets = np.random.default_rng(0).normal(0.0, WIDTH, (20_000, 3))
    found = []
    for blob in BLOBS:
        at = locate(box.mesh, np.concatenate([blob + offsets, blob - offsets]))
        now = at.read((box.mesh.nodes + moved)[None])[0]
        rest = signed_volumes(box.mesh.nodes, at.vertices)
        found.append(np.average(now, axis=0, weights=signed_volumes(box.mesh.nodes + moved, at.vertices) / rest))
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
def test_simpleitk_lands_landmarks_where_the_finite_elements_have_them(kind, folder, out, middles):
    field = sitk.ReadImage(str(out / "field_resampling.nii.gz"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    scan = sitk.ReadImage(str(folder / f"{kind}.nii.gz"))
    assert np.abs(centroids(scan, BLOBS) - BLOBS).max() < 0.03e-3
    itk = sitk.Resample(scan, scan, transform, sitk.sitkLinear, 0.0)
    error = np.linalg.norm(centroids(itk, middles) - middles, axis=1)
    assert error.max() < 0.05e-3, 1e3 * error
    ours = sitk.ReadImage(str(out / f"{kind}_deformed.nii.gz"))
    assert np.linalg.norm(centroids(ours, middles) - middles, axis=1).max() < 0.05e-3
    apart = np.abs(sitk.GetArrayFromImage(ours) - sitk.GetArrayFromImage(itk))
    assert apart.max() < 0.5  # of 1000
    assert np.linalg.norm(middles - BLOBS, axis=1).min() > 0.4e-3


@pytest.mark.parametrize("kind", MAPPED)
def test_label_maps_keep_their_labels_type_and_place(kind, folder, out, middles):
    before, after = nibabel.load(folder / f"{kind}_labels.nii.gz"), nibabel.load(out / f"{kind}_labels_deformed.nii.gz")
    assert after.get_data_dtype() == np.uint8 and np.array_equal(before.affine, after.affine)
    values = np.asarray(after.dataobj)
    assert set(np.unique(values)) == set(range(6))
    points = places(after.affine, values.shape)
    for label, middle in enumerate(middles, 1):
        assert np.linalg.norm(points[values == label].mean(axis=0) - middle) < 0.8e-3 * max(
            GRIDS[kind][1]
        )  # of whole voxels


def test_points_go_the_way_that_tissue_goes(box, out):
    """ITK's own forward field, through the NRRD, moves points: no sign and no axis is mixed up."""
    field = sitk.ReadImage(str(out / "field_modeling.nrrd"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    now = 1e-3 * LPS * np.array([transform.TransformPoint((1e3 * blob * LPS).tolist()) for blob in BLOBS])
    truth = locate(box.mesh, BLOBS).read((box.mesh.nodes + bump(box.mesh.nodes))[None])[0]
    assert np.abs(now - truth).max() < 0.05e-3


def test_each_landmark_is_a_place_in_tissue_that_the_field_for_points_carries(out):
    field = sitk.ReadImage(str(out / "field_modeling.nrrd"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    controls = json.loads((out / "landmarks.mrk.json").read_text())["markups"][0]["controlPoints"]
    points = {point["label"]: np.array(point["position"]) for point in controls}
    stated = json.loads((out / "warp.json").read_text())["grid_error_mm"]["landmarks_worst"]
    for name in ("tumour", "open cortex"):
        now = points[f"{name}, now"]
        carried = transform.TransformPoint(points[f"{name}, in the scan"].tolist())
        assert np.linalg.norm(carried - now) < stated + 0.05 and stated < 0.1
        assert np.linalg.norm(points[f"{name}, in the scan"] - now) > 1.0


def test_the_landmarks_of_a_tumour_that_is_hollow_say_so(box):
    middles = box.mesh.nodes[box.mesh.tets].mean(axis=1)
    tumour = np.flatnonzero(box.mesh.region == 2)
    hollow = box.without(tumour[np.linalg.norm(middles[tumour] + [0.0, 0.0, 22e-3], axis=1) < 5e-3])
    moved = bump(box.mesh.nodes)
    nearest, cortex = landmarks_of(hollow, moved)
    assert nearest.name == NEAREST and cortex.name == "open cortex"
    np.testing.assert_allclose(
        nearest.now, nearest.rest + locate(hollow.mesh, nearest.rest[None]).read(moved[None])[0, 0]
    )


def test_itk_finds_no_fold(out):
    for name in ("field_resampling.nii.gz", "field_modeling.nrrd"):
        field = sitk.ReadImage(str(out / name), sitk.sitkVectorFloat64)
        least = sitk.GetArrayFromImage(sitk.DisplacementFieldJacobianDeterminant(field)).min()
        said = json.loads((out / "warp.json").read_text())["least_jacobian"]
        assert least >= min(said.values()) > 0.4


def test_slicer_is_said_what_the_fields_are(out):
    values, header = nrrd.read(str(out / "field_modeling.nrrd"))
    assert header["kinds"] == ["vector", "domain", "domain", "domain"] and header["space"] == "left-posterior-superior"
    assert header["displacement field type"] == "modeling" and header["intent_code"] == "1006"
    assert np.array_equal(header["measurement frame"], np.eye(3)) and values.shape[0] == 3
    field = nibabel.load(out / "field_resampling.nii.gz")
    assert field.shape[3:] == (1, 3) and field.header.get_intent()[0] == "displacement vector"
    assert field.header["intent_code"] == 1006 and field.header.get_xyzt_units()[0] == "mm"
    assert field.get_data_dtype() == np.float32 and int(field.header["sform_code"]) and int(field.header["qform_code"])


def test_meshes_say_their_space(box, out):
    now = 1e3 * (box.mesh.nodes + bump(box.mesh.nodes))[box.tumour_surface]
    stl = (out / "tumour.stl").read_bytes()
    assert b"SPACE=LPS" in stl[:80] and not stl.startswith(b"solid")
    assert struct.unpack("<I", stl[80:84])[0] == len(now)
    read = trimesh.load(out / "tumour.stl")
    assert np.allclose(read.bounds, np.stack([(now * LPS).min(axis=(0, 1)), (now * LPS).max(axis=(0, 1))]), atol=1e-3)
    assert read.is_watertight and read.volume > 0.0
    tree = ElementTree.parse(out / "tumour.vtp").getroot()
    space = next(array for array in tree.iter("DataArray") if array.get("Name") == "SPACE")
    assert bytes(int(code) for code in space.text.split()) == b"LPS\0"
    assert tree.get("type") == "PolyData"


def test_gltf_is_in_metres_with_the_head_up(box, out):
    read = trimesh.load(out / "deformed.glb")
    assert set(read.geometry) == {"brain", "cortex", "tumour"}
    now = (box.mesh.nodes + bump(box.mesh.nodes))[np.unique(box.tumour_surface)]
    right, front, head = now.mean(axis=0)
    found = read.geometry["tumour"].vertices
    assert np.allclose(np.unique(found.round(6), axis=0).mean(axis=0), [-right, head, front], atol=1e-4)
    assert read.geometry["tumour"].volume > 0.0  # a mirrored one would be inside out


def test_markups_and_figures(out):
    landmarks = json.loads((out / "landmarks.mrk.json").read_text())
    assert landmarks["@schema"].endswith("markups-schema-v1.0.3.json#")
    (markup,) = landmarks["markups"]
    assert markup["type"] == "Fiducial" and markup["coordinateSystem"] == "LPS"
    assert {point["positionStatus"] for point in markup["controlPoints"]} == {"defined"}
    assert [point["label"] for point in markup["controlPoints"]][:2] == ["tumour, in the scan", "tumour, now"]
    report = json.loads((out / "warp.json").read_text())
    assert set(report["files"]) | {"warp.json"} == {path.name for path in out.iterdir()}
    assert report["sha256"] == {one: hashlib.sha256((out / one).read_bytes()).hexdigest() for one in report["files"]}
    text = (out / "README.txt").read_text()
    assert "Not a medical device" in text and "RAS" in text and "nothing folds" in text


def test_slicerio_reads_tumour_and_bound(box, out):
    read = slicerio.read_segmentation(str(out / "tumour.seg.nrrd"))
    tumour, shell = read["segments"]
    assert tumour["name"] == "tumour" and "95 %" in shell["name"]
    voxels, edge = read["voxels"], abs(read["ijkToLPS"][0, 0])
    now = box.mesh.nodes + bump(box.mesh.nodes)
    size = signed_volumes(now, box.mesh.tets[box.mesh.region == 2]).sum()
    assert np.isclose((voxels == tumour["labelValue"]).sum() * (1e-3 * edge) ** 3, size, rtol=0.03)
    middle = np.argwhere(voxels == 1).mean(axis=0)
    where = (read["ijkToLPS"] @ [*middle, 1.0])[:3] * LPS
    controls = json.loads((out / "landmarks.mrk.json").read_text())["markups"][0]["controlPoints"]
    (centroid,) = (point["position"] for point in controls if point["label"] == "centroid of the tumour now")
    assert np.linalg.norm(where - LPS * centroid) < 0.05
    bound = json.loads((out / "warp.json").read_text())["bound_mm"]
    assert np.isclose(bound, 1e3 * np.sqrt(7.815 * 4e-6), rtol=1e-3)
    outer = np.argwhere(voxels > 0)
    inner = np.argwhere(voxels == 1)
    assert np.abs((inner.min(axis=0) - outer.min(axis=0)) * edge - bound).max() < 2 * edge
