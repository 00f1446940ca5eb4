"""`sulcus calibrate`: camera, pivot and hand-eye calibration from files, and rejected input."""

import json
import zlib

import cv2
import numpy as np
import pytest
from board_scenes import HEIGHT, WIDTH, K, picture, poses
from scipy.spatial.transform import Rotation

from ar.screen import write_video
from scenes.cli import main
from scenes.tracked.calibration_file import read_calibration

HEAD = "time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw"


@pytest.fixture(scope="module")
def pictures():
    return [picture(T) for T in poses(10)]


@pytest.fixture(scope="module")
def folder(pictures, tmp_path_factory):
    """Pictures as PNG and JPEG, one of 16 bits, one without the board, and a file that is none."""
    folder = tmp_path_factory.mktemp("pictures")
    for number, grey in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number:02d}.{'jpg' if number % 2 else 'png'}"), grey)
    cv2.imwrite(str(folder / "02.png"), pictures[2].astype(np.uint16) * 256)
    cv2.imwrite(str(folder / "empty.PNG"), np.full_like(pictures[0], 120))
    (folder / "notes.txt").write_text("no picture")
    return folder


def refused(words, capsys):
    """The sentence with which a command is refused."""
    assert main(["calibrate", *map(str, words)]) == 2
    out, error = capsys.readouterr()
    (line,) = error.splitlines()
    assert line.startswith("sulcus calibrate: ") and line.endswith(".") and not out
    return line


def test_image_folder_gives_camera_and_covariance(folder, tmp_path, capsys):
    out = tmp_path / "new" / "camera.yaml"
    assert main(["calibrate", str(folder), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "11 images, the board in 10, 10 views used" in said and "rms 0." in said and "\nfx 5" in said
    found = read_calibration(out)
    assert found.name == "sulcus calibrate: camera" and (found.width, found.height) == (WIDTH, HEIGHT)
    np.testing.assert_allclose(found.K, K, atol=2.5)
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["parameters"] == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    np.testing.assert_allclose(report["values"], [*found.focal, *found.principal, *found.lens.coefficients[:5]])
    covariance = np.array(report["covariance"])
    assert covariance.shape == (9, 9) and np.linalg.eigvalsh(covariance).min() > 0.0
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), report["standard_deviations"])
    # Again, by force: it says what it wrote.
    assert main(["calibrate", str(folder), "--out", str(out), "--size", f"{WIDTH}x{HEIGHT}", "--json", "--force"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads(out.with_suffix(".json").read_text()) and 0.3 < report["covered"] < 1.0
    assert len(report["used"]) == 10 and report["left_out"] == [] and report["looked_at"] == 11


def test_video_gives_same_camera_as_image_folder(pictures, tmp_path, capsys):
    film = tmp_path / "board.mp4"
    write_video(film, (np.repeat(grey[..., None], 3, axis=2) for grey in pictures), 10.0)
    assert main(["calibrate", str(film), "--out", str(tmp_path / "camera.yml"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["looked_at"] == 10 and report["used"][0] == "frame 0"
    assert np.abs(read_calibration(tmp_path / "camera.yml").K - K).max() < 6.0


def test_images_without_the_board_are_rejected(folder, pictures, tmp_path, capsys):
    out = ["--out", tmp_path / "camera.yaml"]
    assert "none.mp4: no such file. Give a video" in refused([tmp_path / "none.mp4", *out], capsys)
    assert "holds no images. Give a folder" in refused([tmp_path, *out], capsys)
    (tmp_path / "text.mp4").write_text("no film")
    assert "text.mp4: is not a readable video, as its bytes are not a video's: give" in refused(
        [tmp_path / "text.mp4", *out], capsys
    )
    assert "640 x 480 pixels, but 1280 x 960 was given" in refused([folder, *out, "--size", "1280x960"], capsys)
    assert "--size '640' is no size" in refused([folder, *out, "--size", "640"], capsys)
    some = tmp_path / "some"
    some.mkdir()
    cv2.imwrite(str(some / "a.png"), np.full_like(pictures[0], 120))
    assert "the board is in none of 1 images: print it" in refused([some, *out], capsys)
    for number in range(3):
        cv2.imwrite(str(some / f"b{number}.png"), pictures[number])
    assert "3 sharp views show the board, but 8 are needed" in refused([some, *out], capsys)
    cv2.imwrite(str(some / "c.png"), pictures[0][:400])
    assert "c.png has 640 x 400 pixels, but a.png has 640 x 480" in refused([some, *out], capsys)
    (some / "c.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    assert "c.png: is not a readable image. Remove it" in refused([some, *out], capsys)
    huge = bytearray(cv2.imencode(".png", pictures[0][:8, :8])[1].tobytes())
    for width, height in ((60_000, 60_000), (12_000, 9_000), (9_000, 8_000), (20_000, 10)):  # what the header says
        huge[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
        huge[29:33] = zlib.crc32(huge[12:29]).to_bytes(4, "big")
        (some / "c.png").write_bytes(huge)
        assert "c.png: has more pixels than a camera gives" in refused([some, *out], capsys)
    assert not list(tmp_path.glob("camera*"))


def test_calibrate_keeps_existing_files_without_force(folder, tmp_path, capsys):
    for name in ("camera.yaml", "camera.json"):
        mine = tmp_path / name
        mine.write_text("image_width: 3")
        assert f"{name}: exists. Give --force" in refused([folder, "--out", tmp_path / "camera.yaml"], capsys)
        assert [path.read_text() for path in tmp_path.iterdir()] == ["image_width: 3"]
        mine.unlink()
    assert "give a name with this extension" in refused([folder, "--out", tmp_path / "camera.txt"], capsys)
    assert "give --out K.yaml" in refused([folder], capsys)


def test_calibrate_rejects_conflicting_inputs(folder, tmp_path, capsys):
    assert "give a video or" in refused([], capsys)
    assert "give a video or" in refused([folder, "--pivot", tmp_path / "a.csv", "--out", "k.yaml"], capsys)
    assert "--out and --size require" in refused(["--pivot", tmp_path / "a.csv", "--out", "k.yaml"], capsys)


def write_poses(path, turns, places, head=HEAD, more=""):
    """A file of poses: turns, and places (n, 3) [m]."""
    rows = np.column_stack([0.1 * np.arange(len(places)), 1e3 * np.asarray(places), turns.as_quat()])
    text = "\n".join(",".join(map(repr, row.tolist())) + more for row in rows)
    path.write_text(f"{head}\n{text}\n")
    return path


def turned(count, seed=0):
    return Rotation.from_rotvec(0.5 * np.random.default_rng(seed).normal(size=(count, 3)))


def test_pivot_calibration_finds_tip_from_pose_file(tmp_path, capsys):
    turns, tip = turned(20), np.array([0.001, 0.002, -0.15])
    path = write_poses(tmp_path / "poses.csv", turns, [0.1, 0.2, 0.3] - turns.apply(tip), f"{HEAD},note", ",good")
    assert main(["calibrate", "--pivot", str(path)]) == 0
    assert "tip in the tool's frame: 1.000 +-" in capsys.readouterr().out
    assert main(["calibrate", "--pivot", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(report["tip_mm"], 1e3 * tip, atol=1e-6)
    np.testing.assert_allclose(report["centre_mm"], [100.0, 200.0, 300.0], atol=1e-6)
    assert np.shape(report["covariance_mm2"]) == (6, 6) and report["rms_mm"] < 1e-6
    few = write_poses(tmp_path / "few.csv", turned(5), np.zeros((5, 3)))
    assert "few.csv: 5 poses are too few" in refused(["--pivot", few], capsys)


def test_hand_eye_calibration_finds_transform_from_two_files(tmp_path, capsys):
    turns, places = turned(20), np.random.default_rng(1).normal(size=(20, 3))
    X = Rotation.from_rotvec([0.3, -0.5, 0.9])
    shift = np.array([0.05, -0.02, 0.12])
    one = write_poses(tmp_path / "one.csv", turns, places)
    other = write_poses(tmp_path / "other.csv", turns * X, places + turns.apply(shift))
    assert main(["calibrate", "--hand-eye", str(one), str(other)]) == 0
    assert "X, where x_A = X x_B" in capsys.readouterr().out
    assert main(["calibrate", "--hand-eye", str(one), str(other), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(report["rotation"], X.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(report["shift_mm"], 1e3 * shift, atol=1e-6)
    short = write_poses(tmp_path / "short.csv", turned(19), np.zeros((19, 3)))
    assert "have rows at different times" in refused(["--hand-eye", one, short], capsys)
    still = write_poses(tmp_path / "still.csv", turned(1) * Rotation.identity(20), np.zeros((20, 3)))
    assert "still.csv: 0 motions turn the bodies" in refused(["--hand-eye", one, still], capsys)


def w_first(turns):
    """The rotations that are read if quaternions are stored as w, x, y, z."""
    return Rotation.from_quat(np.roll(turns.as_quat(), 1, axis=1))


def pivoting(count=60):
    """Turns, and places [m] of a tool whose tip stays."""
    turns = turned(count)
    return turns, [0.1, 0.2, 0.3] - turns.apply([0.003, -0.002, -0.15])


@pytest.mark.parametrize(
    ("stored", "hint"),
    [
        (w_first, "The quaternions fit as w, x, y, z in "),
        (Rotation.inv, "The quaternions fit inverted in "),
        (lambda turns: turned(len(turns), 5), "Leave out wrong rows, and give qx,qy,qz,qw"),
    ],
)
def test_pivot_with_wrong_quaternions_is_rejected(tmp_path, capsys, stored, hint):
    turns, places = pivoting()
    line = refused(["--pivot", write_poses(tmp_path / "poses.csv", stored(turns), places)], capsys)
    assert "mm (rms): at most 3 mm are required. The largest residual is " in line and hint in line


def test_pivot_with_one_wrong_row_names_the_row(tmp_path, capsys):
    turns, places = pivoting()
    places[20] += [0.0, 0.3, 0.0]
    path = write_poses(tmp_path / "poses.csv", turns, places)
    assert f"mm, in row 22 of {path}. Leave out" in refused(["--pivot", path], capsys)
    lines = path.read_text().splitlines()
    lines[3] = "0.2,,,,,,,"  # a row without a pose keeps its number
    path.write_text("\n".join(lines))
    assert "in row 22 of" in refused(["--pivot", path], capsys)


@pytest.mark.parametrize(
    ("first", "second", "hint"),
    [
        (w_first, w_first, "fit as w, x, y, z in {one} and as w, x, y, z in {other}: give"),
        (None, w_first, "fit as w, x, y, z in {other}: give"),
        (Rotation.inv, None, "fit inverted in {one}: give"),
        (None, None, "in row 9 of {one}. Leave out wrong rows, and give"),
    ],
)
def test_hand_eye_with_inconsistent_poses_is_rejected(tmp_path, capsys, first, second, hint):
    turns, places = turned(20), np.random.default_rng(1).normal(size=(20, 3))
    others = places + turns.apply([0.05, -0.02, 0.12])
    others[7] += 0.3 * (first is second is None)
    one, other = (
        write_poses(tmp_path / name, each if stored is None else stored(each), where)
        for name, stored, each, where in (
            ("one.csv", first, turns, places),
            ("other.csv", second, turns * Rotation.from_rotvec([0.3, -0.5, 0.9]), others),
        )
    )
    line = refused(["--hand-eye", one, other], capsys)
    assert "mm (rms): at most 2 and 10 are required" in line and hint.format(one=one, other=other) in line


def test_pivot_positions_in_metres_give_a_warning(tmp_path):
    turns, places = pivoting()
    words = ["calibrate", "--pivot", str(write_poses(tmp_path / "poses.csv", turns, 1e-3 * places))]
    with pytest.warns(UserWarning, match=r"poses\.csv: positions move by only 0\.25 mm: are they metres\?"):
        assert main(words) == 0
