"""Oblique, mirrored and anisotropic scan of a patient: one tumour position in all files, by other readers."""

import csv
import io
import json
from dataclasses import replace
from xml.etree import ElementTree

import h5py
import meshio
import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import slicerio
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from theatres import short

from ar.tracking.pose import PoseStatus
from ar.tracking.registration import Registration
from scenes.cli import main
from scenes.episodes.episode import EpisodeRecording, collect
from scenes.play.deformers import PatientSetup
from scenes.play.player import Player
from scenes.play.stage import Stage
from scenes.tracked.pose_file import TrackedPose, write_poses
from scenes.tracked.registration_file import describe_scan, write_registration
from scenes.tracked.run import write_tracking_table
from scenes.tracked.tracked_tool import TrackedTool, read_tool, write_tool
from scenes.tracked.truth import VideoGroundTruth, write_truth, write_truth_table
from sim.bodies.meshfile import read_anatomy, write_mesh
from sim.tools import Ball
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw

TUMOUR, MIDDLE = np.array([19.0, 2.0, 26.0]), np.array([5.0, -8.0, 12.0])
"""Middles of the tumour and of the brain [mm, RAS]."""
SHIFT = np.array([1.5, -2.0, -3.0])
"""How far the tumour moves [mm, RAS]: no two parts alike, so that no axes can change places unseen."""
VOXEL, SHAPE = np.array([2.4, 2.8, 3.4]), (34, 34, 28)
LPS = np.array([-1.0, -1.0, 1.0])
EXACT, COARSE = 0.35, 0.5 * float(np.linalg.norm(VOXEL))
"""How far apart the middles of a mesh and of voxels may lie, and of labels that move by whole voxels [mm]."""


def near(place, expected, error=EXACT):
    assert np.linalg.norm(np.asarray(place) - expected) < error, (place, expected)


def scan():
    """The affine [mm, RAS]; on its grid a brain of labels 1 with a tumour of labels 2, and distances from that [mm]."""
    turn = Rotation.from_euler("xyz", [20.0, -15.0, 30.0], degrees=True).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = turn * (VOXEL * [-1.0, 1.0, 1.0])
    affine[:3, 3] = MIDDLE - affine[:3, :3] @ (0.5 * (np.array(SHAPE) - 1.0))
    places = np.moveaxis(np.indices(SHAPE), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
    labels = (np.linalg.norm((places - MIDDLE) / [0.86, 1.1, 1.0], axis=-1) < 36.0).astype(np.uint8)
    away = np.linalg.norm(places - TUMOUR, axis=-1)
    labels[away < 9.0] = 2
    return affine, labels, away


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """`labels.nii.gz`, `spot.nii.gz` (bright towards the tumour), `patient.vtu`, `located.vtu`, and a warp."""
    folder = tmp_path_factory.mktemp("oblique")
    affine, labels, away = scan()
    assert np.linalg.det(affine) < 0.0
    nibabel.save(nibabel.Nifti1Image(labels, affine), folder / "labels.nii.gz")
    nibabel.save(nibabel.Nifti1Image((900.0 - 10.0 * away).astype(np.float32), affine), folder / "spot.nii.gz")
    mesh, label_map, t1 = (str(folder / name) for name in ("patient.vtu", "labels.nii.gz", "spot.nii.gz"))
    words = ["--brain", "1", "--tumour", "2", "--nodes", "2000", "--t1", t1]
    assert main(["anatomy", "--labels", label_map, *words, "--out", mesh]) == 0
    anatomy = read_anatomy(mesh)
    still = np.clip((np.linalg.norm(1e3 * anatomy.mesh.nodes - TUMOUR, axis=1) - 10.0) / 22.0, 0.0, 1.0)
    data = {"displacement": 1e-3 * SHIFT * (1.0 - still[:, None])}
    located = str(folder / "located.vtu")
    write_mesh(located, anatomy.mesh, data, "RAS")
    words = ["--located", located, "--labels", label_map, "--image", t1, "--spacing", "2"]
    assert main(["warp", mesh, *words, "--out", str(folder / "warp")]) == 0
    return folder


def brightest(path, more_than):
    """Where the bright voxels of SimpleITK's image lie in the mean [mm, RAS]."""
    image = sitk.ReadImage(str(path))
    places = np.argwhere(sitk.GetArrayFromImage(image) > more_than)[:, ::-1].astype(float)
    return LPS * np.mean([image.TransformContinuousIndexToPhysicalPoint(place) for place in places.tolist()], axis=0)


def test_mesh_files_state_ras_and_metres(folder):
    for name in ("patient.vtu", "located.vtu"):
        read = meshio.read(folder / name)
        assert list(read.field_data) == ["RAS, metres per unit"] and read.field_data["RAS, metres per unit"] == 1.0
        assert "<!-- sulcus: RAS; metres -->" in (folder / name).read_bytes()[:400].decode("ascii", "replace")
        tumour = read.cells_dict["tetra"][read.cell_data["region"][0] == 2]
        near(1e3 * read.points[tumour].mean(axis=(0, 1)), TUMOUR)
    near(1e3 * read.point_data["displacement"][np.unique(tumour)].mean(axis=0), SHIFT, 0.1)


def test_images_have_the_position_of_the_scan(folder):
    near(brightest(folder / "labels.nii.gz", 1.5), TUMOUR)
    near(brightest(folder / "patient.t1.nii.gz", 190), TUMOUR)
    now = TUMOUR + SHIFT
    near(brightest(folder / "warp/labels_deformed.nii.gz", 1.5), now, COARSE)
    near(brightest(folder / "warp/spot_deformed.nii.gz", 810.0), now)
    header = nibabel.load(folder / "patient.t1.nii.gz").header
    assert header.get_xyzt_units()[0] == "mm" and int(header["sform_code"]) > 0


def test_forward_and_inverse_fields_map_tumour_and_back(folder):
    now = TUMOUR + SHIFT
    for name, start, end in (("modeling.nrrd", TUMOUR, now), ("resampling.nii.gz", now, TUMOUR)):
        field = sitk.ReadImage(str(folder / f"warp/field_{name}"), sitk.sitkVectorFloat64)
        moved = sitk.DisplacementFieldTransform(field).TransformPoint((LPS * start).tolist())
        near(LPS * moved, end, 0.1)
    header = nrrd.read_header(str(folder / "warp/field_modeling.nrrd"))
    assert header["space"] == "left-posterior-superior" and header["space units"] == ["mm"] * 3


def test_exported_surfaces_points_and_segments_follow_tumour(folder):
    warp, now = folder / "warp", TUMOUR + SHIFT
    near(LPS * trimesh.load(warp / "tumour.stl").center_mass, now)
    assert b"SPACE=LPS" in (warp / "tumour.stl").read_bytes()[:80]
    left, head, front = 1e3 * trimesh.load(warp / "deformed.glb").geometry["tumour"].center_mass
    near([-left, front, head], now)
    arrays = {array.get("Name"): array for array in ElementTree.parse(warp / "tumour.vtp").iter("DataArray")}
    assert bytes(map(int, arrays["SPACE"].text.split())) == b"LPS\0"
    (markup,) = json.loads((warp / "landmarks.mrk.json").read_text())["markups"]
    assert (markup["coordinateSystem"], markup["coordinateUnits"]) == ("LPS", "mm")
    at = {point["label"]: LPS * point["position"] for point in markup["controlPoints"]}
    near(at["tumour, in the scan"], TUMOUR)
    near(at["tumour, now"], now)
    read = slicerio.read_segmentation(str(warp / "tumour.seg.nrrd"))
    middle = np.argwhere(read["voxels"] == read["segments"][0]["labelValue"]).mean(axis=0)
    near(LPS * (read["ijkToLPS"] @ [*middle, 1.0])[:3], now)
    said = json.loads((warp / "warp.json").read_text())["spaces"]
    assert (said["field_resampling.nii.gz"], said["landmarks.mrk.json"]) == ("RAS, mm", "LPS, mm")


def test_data_sets_and_registrations_name_their_spaces(folder, pretender):
    anatomy = read_anatomy(folder / "patient.vtu")
    path = folder / "data.h5"
    simulate(path, replace(pretender, anatomy=anatomy), draw("palpation", anatomy, 2, 0), {})
    with h5py.File(path) as file:
        nodes = file["anatomy/nodes"]
        assert nodes.attrs["unit"] == "m" and nodes.attrs["frame"] == "RAS"
        near(1e3 * nodes[:][file["anatomy/tets"][:][file["anatomy/region"][:] == 2]].mean(axis=(0, 1)), TUMOUR)
    exact = Registration(np.eye(4), 1e-8 * np.eye(6), np.zeros(3), 0.0, 3, 0, describe_scan(anatomy))
    write_registration(folder / "registration.json", exact)
    said = json.loads((folder / "registration.json").read_text())
    assert said["spaces"]["scan"] == "RAS [mm]"
    near(said["scanned"]["tumour_mm"], TUMOUR)


def test_episode_mask_matches_projected_tumour(folder, pretender):
    """Projected by the camera's matrices, the undeformed tumour lies in the middle of its first mask."""
    anatomy = read_anatomy(folder / "patient.vtu")
    theatre = PatientSetup(anatomy, None, {}, "cpu")
    play = Player(Stage(short(), theatre.site, None), replace(pretender, anatomy=anatomy))
    bare = EpisodeRecording(None, overlay=False, with_times=False)
    collect(folder / "press.h5", theatre, play, "fem", iter, recording=bare)
    with h5py.File(folder / "press.h5") as file:
        assert file.attrs["world_frame"] == "RAS [m]" and file.attrs["camera_frame"].startswith("OpenCV: x right")
        assert file["tumour_rest"].attrs["unit"] == "m"
        near(1e3 * file["tumour_rest"][:].mean(axis=0), TUMOUR)
        mask = np.asarray(Image.open(io.BytesIO(file["pictures/tumour_mask"][0].tobytes())))
        camera = file["tumour_predicted"][0] @ file["T_camera_world"][0, :3, :3].T + file["T_camera_world"][0, :3, 3]
        pixels = camera @ file["K"][:].T
    pixels = pixels[:, :2] / pixels[:, 2:]
    rows, columns = np.nonzero(mask)
    seen = np.array([columns, rows])
    assert np.abs(pixels.min(axis=0) - seen.min(axis=1)).max() < 2.0
    assert np.abs(pixels.max(axis=0) - seen.max(axis=1)).max() < 2.0


def test_tables_and_headers_name_their_spaces(tmp_path):
    """Rows of two images with a tumour of one vertex; values are tested with their writers."""
    poses, still = np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 1, 3))
    truth = VideoGroundTruth("digest", np.arange(2.0), poses, poses, still)
    write_truth(tmp_path / "truth.npz", truth)
    assert json.loads(str(np.load(tmp_path / "truth.npz")["header"]))["spaces"]["scan"] == "RAS [m]"
    write_truth_table(tmp_path / "truth.csv", truth, 1e-3 * TUMOUR[None])
    write_poses(tmp_path / "track.csv", [TrackedPose(0.0, PoseStatus.LOST, None, 0.01)], np.zeros(3))
    write_tracking_table(tmp_path / "overlay.csv", [], [])
    (heads, *rows), (tracked, lost), (drawn,) = (
        list(csv.reader((tmp_path / name).read_text().splitlines()))
        for name in ("truth.csv", "track.csv", "overlay.csv")
    )
    assert (heads[-1], rows[0][-1]) == ("space", "RAS") and heads[1] == "tumour_x_mm"
    near([float(value) for value in rows[0][1:4]], TUMOUR, 1e-3)
    assert (tracked[-1], lost[-1]) == ("frame", "camera: x right, y down, z forward")
    assert drawn[-1] == "space" and "tumour_x_mm" in drawn
    write_tool(tmp_path / "tool.json", TrackedTool(Ball(7e-3)))
    assert json.loads((tmp_path / "tool.json").read_text())["spaces"]["cube"] == "the cube's own [mm]"
    assert read_tool(tmp_path / "tool.json").shape == Ball(7e-3)
