"""`sulcus warp`: loads and scenes, rejected input, and images and label maps against SimpleITK."""

import json
from dataclasses import replace

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from warped import BLOBS, GRIDS, LPS, MAPPED, WIDTH, bump, places

from scenes.cli import main
from scenes.warp.images import read_patient_image, warp_values, write_warped_image
from sim.bodies.meshfile import write_anatomy, write_mesh
from sim.fields.warp_fields import compute_warp_fields
from sim.geometry.locate import locate
from sim.geometry.tetmesh import compute_signed_volumes


@pytest.fixture(scope="module")
def middles(box):
    """Where the finite elements take the middles of the spots (5, 3) [m], by themselves: no grid has a part in it."""
    moved = bump(box.mesh.nodes)
    offsets = np.random.default_rng(0).normal(0.0, WIDTH, (20_000, 3))
    out = []
    for blob in BLOBS:
        at = locate(box.mesh, np.concatenate([blob + offsets, blob - offsets]))
        now = at.interpolate((box.mesh.nodes + moved)[None])[0]
        rest = compute_signed_volumes(box.mesh.nodes, at.vertices)
        out.append(np.average(now, axis=0, weights=compute_signed_volumes(box.mesh.nodes + moved, at.vertices) / rest))
    return np.array(out)


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
def test_simpleitk_resampled_blobs_match_fem(kind, warp_folder, warp_out, middles):
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
def test_warped_label_maps_keep_labels_type_and_position(kind, warp_folder, warp_out, middles):
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


def test_itk_moves_points_with_the_tissue(box, warp_out):
    """Forward field of ITK from the NRRD file: no sign and no axis is swapped."""
    field = sitk.ReadImage(str(warp_out / "field_modeling.nrrd"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    now = 1e-3 * LPS * np.array([transform.TransformPoint((1e3 * blob * LPS).tolist()) for blob in BLOBS])
    truth = locate(box.mesh, BLOBS).interpolate((box.mesh.nodes + bump(box.mesh.nodes))[None])[0]
    assert np.abs(now - truth).max() < 0.05e-3


def dimple(nodes, depth=4e-3):
    share = np.clip(1.0 - (np.linalg.norm(nodes[:, :2], axis=1) / 25e-3) ** 2, 0.0, 1.0)
    return np.outer(share * np.clip(1.0 + nodes[:, 2] / 42e-3, 0.0, 1.0), [0.0, 0.0, -depth])


AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])
AFFINE[:3, 3] = [-40.0, -40.0, -50.0]


def save(path, values, affine=AFFINE):
    nibabel.save(nibabel.Nifti1Image(values, affine), path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, box):
    folder = tmp_path_factory.mktemp("asked")
    write_anatomy(folder / "box.vtu", box)
    write_mesh(folder / "located.vtu", box.mesh, {"displacement": dimple(box.mesh.nodes)})
    save(folder / "t1.nii.gz", np.full((40, 40, 32), 100, np.int16))
    return folder


@pytest.fixture(scope="module")
def fields(box):
    return compute_warp_fields(box, dimple(box.mesh.nodes), 2e-3)


def warp(folder, *words, out="out", anatomy="box.vtu"):
    return main(["warp", str(folder / anatomy), *map(str, words), "--spacing", "4", "--out", str(folder / out)])


def test_warp_solves_a_load_and_reports_the_tip(folder, box, capsys):
    words = "--load=1,2,0,0.1", "--device", "cpu", "--json"
    assert warp(folder, *words, out="load") == 0
    report = json.loads(capsys.readouterr().out)
    said = report["cause"]
    assert "a load of 0.1 N at 1.0, 2.0, 0.0 mm towards 0.00, 0.00, -1.00 (RAS)" in report["moved_by"]
    assert (said["kind"], said["place_mm"], said["force_n"]) == ("load", [1.0, 2.0, 0.0], pytest.approx(0.1))
    assert said["direction"] == [0.0, 0.0, -1.0] and "frame" not in said and "scene" not in report["moved_by"]
    assert report["anatomy"] == {"file": "box.vtu", "digest": box.digest}
    assert "finite elements" in report["moved_by"] and report["largest_displacement_mm"] > 0.2
    assert report["bound_mm"] is None and min(report["least_jacobian"].values()) > 0.0
    line = json.loads((folder / "load" / "tip_to_tumour.mrk.json").read_text())["markups"][0]
    tip = np.array([point["position"] for point in line["controlPoints"]])
    assert line["type"] == "Line" and np.isclose(np.linalg.norm(tip[0] - tip[1]), report["tip_to_tumour_mm"], atol=1e-3)
    assert np.abs(tip[0, :2] - [-1.0, -2.0]).max() < 1.5  # LPS
    text = (folder / "load" / "README.txt").read_text()
    assert all(word in text for word in ("not known", "a load of 0.1 N at", f"box.vtu, digest {box.digest}"))
    assert report["spaces"]["field_modeling.nrrd"] == "LPS, mm" and report["spaces"]["cause"] == "RAS, mm"


def test_warp_of_a_scene_writes_a_time_sequence(folder, capsys):
    words = "--scene", "press", "--frame", "60", "--sequence", "60", "--device", "cpu", "--json"
    assert warp(folder, *words, out="scene") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["sequence_frames"] == 3
    assert report["cause"] == {"kind": "scene", "scene": "press", "frame": 60, "time_s": 2.0}
    values, header = nrrd.read(str(folder / "scene" / "field_sequence.seq.nrrd"))
    assert header["kinds"] == ["vector", "domain", "domain", "domain", "list"] and values.shape[0::4] == (3, 3)
    assert header["axis 3 index values"] == "0 2 4" and header["units"][-1] == "s"
    assert header["displacement field type"] == "modeling" and header["intent_code"] == "1006"
    largest = np.linalg.norm(values, axis=0).max(axis=(0, 1, 2))
    assert largest[1] > 5 * largest[0]


def test_warp_warns_of_grid_too_coarse_for_the_tumour(folder, box, capsys):
    moved = np.zeros_like(box.mesh.nodes)
    moved[box.tumour_nodes[0]] = [0.0, 0.0, 1e-3]  # of one vertex: no grid of 4 mm follows it
    write_mesh(folder / "narrow.vtu", box.mesh, {"displacement": moved})
    for name, coarse in (("narrow.vtu", True), ("located.vtu", False)):
        assert warp(folder, "--located", folder / name, out=f"{name}.warp") == 0
        assert ("a smaller --spacing" in capsys.readouterr().err) == coarse
        assert ("the grid is coarse" in (folder / f"{name}.warp" / "README.txt").read_text()) == coarse


def test_warped_intensities_keep_scale_and_type(folder, box, fields):
    image = nibabel.Nifti1Image(np.arange(40 * 40 * 32).reshape(40, 40, 32).astype(np.int16) % 700, AFFINE)
    image.header.set_slope_inter(0.5, -10.0)
    nibabel.save(image, folder / "scaled.nii")
    found = write_warped_image(folder, read_patient_image(folder / "scaled.nii", box, False), fields, "cubic")
    before, after = nibabel.load(folder / "scaled.nii"), nibabel.load(folder / "scaled_deformed.nii.gz")
    assert after.get_data_dtype() == np.int16 and (after.dataobj.slope, after.dataobj.inter) == (0.5, -10.0)
    assert np.array_equal(after.affine, before.affine) and after.header["qform_code"] == before.header["qform_code"]
    same = np.asarray(before.dataobj) == np.asarray(after.dataobj)
    assert 0.1 < same.mean() < 0.9 and found.moved >= (~same).sum()


def test_voxels_from_outside_or_resection_are_zero_and_counted(box, fields):
    affine = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    affine[:3, 3] = [-10e-3, -10e-3, -8e-3]  # its top lies below what is pushed into it
    out, counts = warp_values(np.full((20, 20, 6), 9, np.uint8), affine, fields, 1)
    assert counts.outside > 200 and (out[counts.unfilled] == 0).all() and (out[~counts.unfilled] == 9).all()
    cut = compute_warp_fields(
        box, dimple(box.mesh.nodes), 2e-3, box.remove_elements(np.flatnonzero(box.mesh.region == 2))
    )
    affine[2, 3] = -40e-3
    out, counts = warp_values(np.full((20, 20, 36), 9, np.uint8), affine, cut, 0)
    assert counts.resected > 1000 and (out == 0).sum() == counts.resected + counts.outside


def nan_place(path):
    header = nibabel.Nifti1Header()
    header.set_data_shape((40, 40, 32))
    header.set_data_dtype(np.uint8)
    header["sform_code"] = 1
    for row in ("srow_x", "srow_y", "srow_z"):
        header[row] = np.nan
    header["vox_offset"] = 352
    path.write_bytes(header.binaryblock + bytes(4) + bytes(40 * 40 * 32))


FAR = AFFINE.copy()
FAR[0, 3] = 400.0
REFUSED = {
    "far.nii.gz": (lambda path: save(path, np.ones((40, 40, 32), np.uint8), FAR), "shows none of this brain"),
    "series.nii.gz": (lambda path: save(path, np.ones((40, 40, 32, 3), np.uint8)), "not one volume"),
    "slice.nii.gz": (lambda path: save(path, np.ones((40, 40), np.uint8)), "not one volume"),
    "nowhere.nii": (nan_place, "singular"),
    "scan.png": (lambda path: path.write_bytes(b"no image"), "unsupported file type; expected .nii"),
    "none.nii.gz": (lambda path: None, "no such file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unsuitable_image_is_rejected_by_name(name, folder, capsys):
    make, reason = REFUSED[name]
    make(folder / name)
    assert warp(folder, "--located", folder / "located.vtu", "--image", folder / name, out="refused") == 2
    error = capsys.readouterr().err
    assert name in error and reason in error and not (folder / "refused").exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--scene", "press"], "--frame"),
        (["--scene", "press", "--frame", "999"], "0 to 120"),
        (["--scene", "none", "--frame", "1"], "no scene is called"),
        (["--load", "1,2,0,0.1", "--frame", "3"], "--scene"),
        (["--load=-1,2,0,-0.1"], "no push"),
        (["--load", "300,2,0,0.1"], "from the open cortex"),
        (["--load", "1,2,nan,0.1"], "from the open cortex"),
        (["--load", "1,2,0,0.1", "--spacing", "0"], "--spacing"),
        (["--scene", "press", "--frame", "1", "--sequence", "0"], "--sequence"),
    ],
)
def test_warp_rejects_contradictory_options(words, reason, folder, capsys):
    assert main(["warp", str(folder / "box.vtu"), *words, "--out", str(folder / "refused")]) == 2
    error = capsys.readouterr().err
    assert reason in error and not (folder / "refused").exists()


def test_warp_rejects_other_mesh_and_non_integer_labels(folder, box, capsys):
    other = box.remove_elements(np.arange(5)).mesh
    write_mesh(folder / "other.vtu", other, {"displacement": dimple(other.nodes)})
    for name, reason in (("other.vtu", "another mesh"), ("box.vtu", "no point data `displacement`")):
        assert warp(folder, "--located", folder / name, out="refused") == 2
        assert reason in capsys.readouterr().err
    save(folder / "grey.nii.gz", np.full((40, 40, 32), 0.5, np.float32))
    assert warp(folder, "--located", folder / "located.vtu", "--labels", folder / "grey.nii.gz", out="refused") == 2
    assert "no label map" in capsys.readouterr().err
    twice = ["--image", folder / "t1.nii.gz", "--labels", folder / "t1.nii.gz"]
    assert warp(folder, "--located", folder / "located.vtu", *twice, out="refused") == 2
    assert "would both become" in capsys.readouterr().err


def test_warp_warns_of_suspicious_images(folder, box, capsys):
    empty, part = np.zeros((40, 40, 32), np.float32), np.ones((12, 40, 32), np.float32)
    empty[:5], part[0, 0, 0] = 1.0, np.nan
    save(folder / "empty.nii.gz", empty)
    image = nibabel.Nifti1Image(part, None)
    image.header.set_zooms((2.0, 2.0, 2.0))
    nibabel.save(image, folder / "part.nii.gz")  # neither sform nor qform
    said = {
        name: " ".join(read_patient_image(folder / name, box, False, "RAS").warnings)
        for name in ("empty.nii.gz", "part.nii.gz")
    }
    assert "another space" in said["empty.nii.gz"]
    assert all(word in said["part.nii.gz"] for word in ("of the brain", "without a number"))


def test_small_tumour_label_map_gives_no_warning(folder, box):
    values = np.zeros((40, 40, 32), np.uint8)
    values[18:23, 18:23, 12:17] = 2
    save(folder / "small.nii.gz", values)
    assert read_patient_image(folder / "small.nii.gz", box, True).warnings == ()
    asked = " ".join(read_patient_image(folder / "small.nii.gz", box, False).warnings)
    assert "another space" in asked and "--labels" in asked


def test_intensities_given_as_labels_give_a_warning(folder, box):
    smooth = 300.0 + 200.0 * np.sin(np.indices((40, 40, 32)).sum(axis=0) / 9.0)
    for name, values, doubted in (("scan", smooth, True), ("many", 1.0 + smooth // 50.0, False)):
        save(folder / f"{name}.nii.gz", values.astype(np.int16))
        said = " ".join(read_patient_image(folder / f"{name}.nii.gz", box, True).warnings)
        assert ("as intensities do: give them by --image" in said) == doubted


def test_empty_share_of_image_is_computed_by_volume(folder, box):
    index = np.rint((1e3 * box.mesh.nodes - AFFINE[:3, 3]) / 2.0).astype(int)
    values = np.ones((40, 40, 32), np.float32)
    values[tuple(index.T)] = 0.0  # one voxel round each vertex
    save(folder / "pitted.nii.gz", values)
    assert not any("is 0" in warning for warning in read_patient_image(folder / "pitted.nii.gz", box, False).warnings)


def test_lps_image_labelled_as_ras_gives_a_warning(folder, box):
    moved = replace(box, mesh=replace(box.mesh, nodes=box.mesh.nodes + [0.0, 15e-3, 0.0]))
    places = np.moveaxis(np.indices((60, 60, 32)), 0, -1) * 2.0 + [-60.0, -60.0, -50.0]
    low, high = 1e3 * moved.mesh.nodes.min(axis=0), 1e3 * moved.mesh.nodes.max(axis=0)
    values = np.random.default_rng(0).normal(5.0, 1.0, places.shape[:3])
    values[((places >= low) & (places <= high)).all(axis=-1)] = 100.3
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = [-60.0, -60.0, -50.0]
    for name, signs in (("right", [1.0, 1.0, 1.0, 1.0]), ("wrong", [-1.0, -1.0, 1.0, 1.0])):
        save(folder / f"{name}.nii.gz", values.astype(np.float32), np.diag(signs) @ affine)
        warnings = read_patient_image(folder / f"{name}.nii.gz", moved, False).warnings
        assert any("LPS marked as RAS" in warning for warning in warnings) == (name == "wrong")


def test_warp_rejects_non_empty_folder(folder, capsys):
    located = "--located", folder / "located.vtu"
    mine = folder / "mine" / "notes.txt"
    mine.parent.mkdir()
    mine.write_text("my own")
    assert warp(folder, *located, out="mine") == 2
    assert "mine: exists and is not empty" in capsys.readouterr().err and list(mine.parent.iterdir()) == [mine]
    mine.unlink()
    assert warp(folder, *located, out="mine") == 0
    before = {path.name for path in mine.parent.iterdir()}
    assert warp(folder, *located, "--image", folder / "t1.nii.gz", out="mine") == 2
    assert {path.name for path in mine.parent.iterdir()} == before
    (folder / "file").write_text("my own")
    assert warp(folder, *located, out="file") == 2


def test_mgh_and_nrrd_images_equal_the_nifti_image(folder, box, fields, tmp_path):
    values = np.random.default_rng(2).integers(0, 200, (40, 40, 32)).astype(np.int16)
    save(tmp_path / "a.nii.gz", values)
    nibabel.save(nibabel.MGHImage(values, AFFINE), tmp_path / "b.mgz")
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ AFFINE
    header = {
        "space": "left-posterior-superior", "space directions": lps[:3, :3].T, "space origin": lps[:3, 3],
        "kinds": ["domain"] * 3,
    }  # fmt: skip
    nrrd.write(str(tmp_path / "c.nrrd"), values.astype(np.int64), header)
    found = {}
    for name in ("a.nii.gz", "b.mgz", "c.nrrd"):
        warped = write_warped_image(tmp_path, read_patient_image(tmp_path / name, box, False), fields, "linear")
        found[name] = nibabel.load(tmp_path / warped.name)
        assert warped.name == f"{name[0]}_deformed.nii.gz" and warped.moved > 100
    for image in found.values():
        assert image.header["sform_code"] > 0
        np.testing.assert_allclose(image.affine, AFFINE, atol=1e-5)
        np.testing.assert_array_equal(image.get_fdata(), found["a.nii.gz"].get_fdata())
