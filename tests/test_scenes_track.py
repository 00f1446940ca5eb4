"""`sulcus track`: poses of printed targets in a video, and blank rows where they are lost."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_ar_pose import CAMERA, CUBE, PLATE, flat, looking, taken

from ar.optics.calibration import Calibration
from ar.tracking.targets import TIP_DISTANCE
from scenes.cli import main
from scenes.tracked.calibration_file import read_calibration, write_calibration
from scenes.tracked.external_tracker import track_video
from scenes.tracked.pose_file import COVARIANCE, read_poses

PLATE_AT = flat((20.0, 15.0, 5.0), (-0.08, 0.0, 0.28))
TIP_AT = np.array([0.0, 0.0, -TIP_DISTANCE, 1.0])


@pytest.fixture(scope="module")
def tools():
    """The cube in three pictures of five; between them it is hidden."""
    return [looking((0.0, 2.0 * k, 3.0), (0.03 + 2e-3 * k, -0.01, 0.25)) for k in range(3)]


@pytest.fixture(scope="module")
def pictures(tools):
    some = [(CUBE, tools[0]), (CUBE, tools[1]), None, None, (CUBE, tools[2])]
    return [taken(*([each] if each else []), (PLATE, PLATE_AT), seed=k) for k, each in enumerate(some)]


@pytest.fixture(scope="module")
def folder(pictures, tmp_path_factory):
    path = tmp_path_factory.mktemp("film")
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(path / f"{number:03d}.png"), picture)
    return path


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    K, size = CAMERA.K, (CAMERA.width, CAMERA.height)
    write_calibration(path, Calibration((K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), *size, CAMERA.lens))
    return str(path)


def read_csv(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_track_command_writes_one_row_per_image(folder, camera, tools, tmp_path, capsys):
    out = tmp_path / "tool.csv"
    assert main(["track", str(folder), "--camera", camera, "--out", str(out), "--rate", "10", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["pictures"] == 5 and said["states"] == {"good": 3, "lost": 2}
    rows = read_csv(out)
    assert [row["state"] for row in rows] == ["good", "good", "lost", "lost", "good"]
    assert [float(row["time_s"]) for row in rows] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert all(rows[2][name] == "" for name in ("x_mm", "qw", "tip_x_mm", "tip_off_mm", *COVARIANCE, "corners"))
    _, times, poses = read_poses(out)
    assert times == pytest.approx([0.0, 0.1, 0.4])
    for row, pose, true in zip([rows[0], rows[1], rows[4]], poses, tools, strict=True):
        tip = np.array([float(row[f"tip_{axis}_mm"]) for axis in "xyz"])
        np.testing.assert_allclose(tip, 1e3 * (pose @ TIP_AT)[:3], atol=1e-2)
        off = float(np.linalg.norm(tip - 1e3 * (true @ TIP_AT)[:3]))
        assert off < 1.5 and off < 4.0 * float(row["tip_off_mm"])
        matrix = np.zeros((6, 6))
        matrix[np.triu_indices(6)] = [float(row[name]) for name in COVARIANCE]
        assert np.linalg.eigvalsh(matrix + matrix.T - np.diag(np.diag(matrix))).min() > 0.0


def test_tool_pose_in_patient_frame_is_independent_of_camera(folder, camera, tools, tmp_path, capsys):
    out = tmp_path / "tool.csv"
    wanted = f"track {folder} --camera {camera} --out {out} --frame patient --tip 1 2 -150".split()
    assert main(wanted) == 0
    assert "in the patient's frame" in capsys.readouterr().out
    tip = np.array([1e-3, 2e-3, -0.15, 1.0])
    for row, true in zip((row for row in read_csv(out) if row["x_mm"]), tools, strict=True):
        found = np.array([float(row[f"tip_{axis}_mm"]) for axis in "xyz"])
        off = np.linalg.norm(found - 1e3 * (np.linalg.inv(PLATE_AT) @ true @ tip)[:3])
        assert off < 4.0 * float(row["tip_off_mm"])
    assert main(["track", str(folder), "--camera", camera, "--out", str(tmp_path / "p.csv"), "--body", "patient"]) == 0
    assert [row["state"] for row in read_csv(tmp_path / "p.csv")] == ["good"] * 5
    capsys.readouterr()
    boardless = f"track {folder} --camera {camera} --out {tmp_path / 'b.csv'} --reference-frame board".split()
    assert main(boardless) == 1 and "60.0 %  board lost: too few corners" in capsys.readouterr().out


def test_camera_pose_is_the_inverse_of_the_patient_pose(folder, camera, tmp_path):
    one, other = tmp_path / "camera.csv", tmp_path / "plate.csv"
    words = ["track", str(folder), "--camera", camera]
    assert main([*words, "--out", str(one), "--body", "camera", "--frame", "patient", "--tip", "0", "0", "0"]) == 0
    assert main([*words, "--out", str(other), "--body", "patient"]) == 0
    (*_, found), (*_, seen) = read_poses(one), read_poses(other)
    np.testing.assert_allclose(found @ seen, np.tile(np.eye(4), (5, 1, 1)), atol=1e-6)
    assert all(float(row["tip_off_mm"]) > 0.0 and int(row["corners"]) < 99 for row in read_csv(one))


def test_track_command_uses_times_of_the_video(pictures, camera, tmp_path):
    film, out = tmp_path / "film.avi", tmp_path / "tool.csv"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (CAMERA.width, CAMERA.height))
    for picture in pictures:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    writer.release()
    assert main(["track", str(film), "--camera", camera, "--out", str(out)]) == 0
    rows = read_csv(out)
    assert [float(row["time_s"]) for row in rows] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])
    assert [row["state"] for row in rows][:2] == ["good", "good"]


def test_track_command_rejects_invalid_options(folder, camera, pictures, tmp_path, capsys):
    out = tmp_path / "tool.csv"

    def refused(*words, camera=camera, folder=folder):
        assert main(["track", str(folder), "--camera", camera, "--out", str(out), *words]) == 2
        assert not out.exists()
        return capsys.readouterr().err

    assert "at rest in its own frame" in refused("--body", "patient", "--frame", "patient")
    assert "--rate 0" in refused("--rate", "0")
    assert "not finite" in refused("--tip", "nan", "0", "0")
    assert "no such file" in refused(folder=tmp_path / "none.mp4")
    small = tmp_path / "small"
    small.mkdir()
    cv2.imwrite(str(small / "a.png"), pictures[0][::2, ::2])
    assert "calibrate it at this size" in refused(folder=small)
    (tmp_path / "text.mp4").write_text("no video")
    assert "not a readable video" in refused(folder=tmp_path / "text.mp4")
    blank = tmp_path / "blank"
    blank.mkdir()
    cv2.imwrite(str(blank / "a.png"), np.full((CAMERA.height, CAMERA.width), 120, np.uint8))
    assert main(["track", str(blank), "--camera", camera, "--out", str(out)]) == 1  # nothing is certain
    assert "100.0 %  tool lost: too few corners" in capsys.readouterr().out
    assert read_csv(out)[0]["state"] == "lost"


def test_incomplete_pose_row_is_rejected(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n1,,2,3,0,0,0,1\n")
    with pytest.raises(ValueError, match="row 3 has a part of a pose"):
        read_poses(path)


def test_times_are_read_from_image_stamps():
    """The last time by the file's frame rate is 2.133 s, which is wrong."""
    film = Path(__file__).parent / "data" / "film"
    rows = track_video(film / "film.mp4", read_calibration(film / "camera.yaml"), "patient", "camera", 30.0)
    assert [row.time for row in rows][-2:] == pytest.approx([2.1333, 2.2667], abs=1e-4)
