"""Films of a scene as a camera takes them: what is true of them, what goes wrong in them, and their files."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from theatres import template_theatre

from ar.tracking.pictures import film_of
from ar.tracking.stamp import CELL, WIDTH, read_stamp, stamped
from ar.tracking.targets import Detector, patient_reference, tool_cube
from ar.tracking.track import Tracker
from scenes.cli import main
from scenes.play.deformers import AtRest
from scenes.play.player import Player
from scenes.script.scene import find_scene
from scenes.tracked.calibration_file import read_intrinsic_covariance, write_calibration
from scenes.tracked.filming import USUAL, VIEW, Taking, Trouble, mounted, registered, shots_of
from scenes.tracked.registration_file import read_registration
from scenes.tracked.tracked_tool import read_tool
from scenes.tracked.truth import read_truth
from sim.errors import InputError
from sim.tools import Ball

SMALL = USUAL.sized(800, 600, scale=True)
TARGETS = (tool_cube(), patient_reference())


@pytest.fixture(scope="module")
def player():
    """The scene palpate on a brain that stays at rest."""
    theatre = template_theatre()
    scene = replace(find_scene("palpate"), viewpoint=VIEW.calibrated(SMALL), duration=0.7)
    return Player(theatre.stage(scene), AtRest(theatre.anatomy))


@pytest.fixture(scope="module")
def shots(player):
    """Seven pictures, with a trouble of each kind but the first and the last."""
    kinds = ("reference", "tool", "bright", "smear", "gap")
    troubles = tuple(Trouble(kind, 0.1 * n + 0.05, 0.1 * n + 0.15) for n, kind in enumerate(kinds))
    return list(shots_of(player, mounted(player), Taking(troubles=troubles), every=3))


def grey(shot):
    return cv2.cvtColor(shot.colour, cv2.COLOR_RGB2GRAY)


def test_both_targets_are_seen_where_they_are(player, shots):
    mounts = mounted(player)
    seen = Tracker(SMALL.camera(np.eye(4)), TARGETS).track(grey(shots[0]))
    wanted = {
        "tool": shots[0].T_scan_tool @ np.linalg.inv(mounts.tool.T_cube_tool),
        "patient": mounts.T_scan_patient,
    }
    assert set(seen.poses) == set(wanted)
    for name, T_scan_target in wanted.items():
        off = seen.poses[name].T_camera_target - shots[0].T_camera_scan @ T_scan_target
        assert np.abs(off[:3, 3]).max() < 0.5e-3 and np.abs(off[:3, :3]).max() < 0.01
    assert len(np.unique(Detector(TARGETS).seen(grey(shots[0]))["tool"].face)) >= 2


def test_what_goes_wrong_does_and_nothing_else(shots):
    detector = Detector(TARGETS)
    found = [set(detector.seen(grey(shot))) for shot in shots]
    both = {"tool", "patient"}
    assert found[0] == found[-1] == both  # before and after
    assert found[1:5] == [{"tool"}, {"patient"}, set(), set()]
    assert [shot.time for shot in shots] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.7])  # 0.5 is left out
    assert [read_stamp(grey(shot)) for shot in shots] == pytest.approx([shot.time for shot in shots])


def test_a_trouble_that_is_none_is_refused():
    with pytest.raises(InputError, match="no trouble is called 'fog'"):
        Trouble("fog", 0.0, 1.0)
    with pytest.raises(InputError, match="two times in order"):
        Trouble("gap", 1.0, 0.5)


def test_a_stamp_outlives_blur_and_noise_and_none_is_read_where_none_is():
    random = np.random.default_rng(0)
    picture = random.integers(0, 256, (100, 500), np.uint8)
    assert read_stamp(picture) is None and read_stamp(picture[:4]) is None
    for time in (0.0, 1.2345, 86_400.0):
        written = stamped(picture, time)
        np.testing.assert_array_equal(written[CELL:], picture[CELL:])
        worn = cv2.GaussianBlur(written, (0, 0), 1.0) + random.normal(0.0, 10.0, written.shape)
        assert read_stamp(np.clip(worn, 0, 255).astype(np.uint8)) == pytest.approx(time)
    for cell in range(4, 44):  # a bit that is read wrongly is noticed
        broken = stamped(picture, 1.2345)
        part = broken[:CELL, -WIDTH + CELL * cell : broken.shape[1] - WIDTH + CELL * (cell + 1)]
        part[:] = 255 - part
        assert read_stamp(broken) is None
    with pytest.raises(ValueError, match="0 to"):
        stamped(picture, -1.0)
    with pytest.raises(ValueError, match="a time needs"):
        stamped(picture[:, :100], 1.0)


def test_a_registration_is_off_as_it_says(player):
    mounts, found = mounted(player), []
    for seed in range(200):
        one = registered(player.site, mounts, 0.5, 0.4, seed)
        off = one.T_patient_scan @ mounts.T_scan_patient
        place, covariance = one.point(player.site.origin + [0.02, 0.0, 0.0])
        true = np.linalg.inv(mounts.T_scan_patient) @ [*(player.site.origin + [0.02, 0.0, 0.0]), 1.0]
        found.append((place - true[:3]) @ np.linalg.solve(covariance, place - true[:3]))
        assert not np.allclose(off, np.eye(4), atol=1e-6)
    assert np.mean(found) == pytest.approx(3.0, rel=0.2)
    exact = registered(player.site, mounts, 0.0, 0.0, 0).T_patient_scan
    np.testing.assert_allclose(exact, np.linalg.inv(mounts.T_scan_patient), atol=1e-12)


def test_a_film_and_all_that_belongs_to_it_are_written(tmp_path, capsys):
    write_calibration(tmp_path / "k.yaml", SMALL)
    out = tmp_path / "film"
    words = ["film", "press", "--deformer", "series-gp", "--camera", str(tmp_path / "k.yaml"), "--out", str(out)]
    few = ["--seconds", "0.7", "--every", "10", "--device", "cpu"]
    assert main([*words, *few, "--png", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["frames"] == 3 and said["tumour_moves_mm"] > 0.01
    theatre = template_theatre()
    stage = theatre.stage(find_scene("press"))
    truth = read_truth(out / "truth.npz", theatre.anatomy.digest, len(stage.tumour_vertices))
    assert truth.at(1.0 / 3.0) == 1 and truth.at(0.1) is None
    pictures = list(film_of(out / "frames", 3.0, colour=True))
    assert [read_stamp(each.grey) for each in pictures] == pytest.approx(truth.times, abs=1e-4)
    assert pictures[0].colour is not None and pictures[0].colour.shape == (600, 800, 3)
    assert read_registration(out / "registration.json").covariance.max() == 0.0
    assert not read_intrinsic_covariance(out / "camera.yaml").any()  # what drew the film is exactly known
    assert read_tool(out / "tool.json").shape == Ball(7e-3)
    rows = list(csv.DictReader((out / "truth.csv").read_text().splitlines()))
    middle = 1e3 * (stage.tumour_at_rest.vertices + truth.displacement[2]).mean(axis=0)
    assert [float(rows[2][f"tumour_{axis}_mm"]) for axis in "xyz"] == pytest.approx(middle, abs=1e-3)
    with pytest.raises(InputError, match="another anatomy"):
        read_truth(out / "truth.npz", "other", len(stage.tumour_vertices))
    with pytest.raises(InputError, match="other shapes"):
        read_truth(out / "truth.npz", theatre.anatomy.digest, 3)
    for more, why in [
        (["--path", "microscope"], "one calibration"),
        (["--noise", "-1"], "not below 0"),
        (["--trouble", "gap:0-9"], "no picture would be taken"),
        (["--trouble", "tool:30-40"], "tool:30-40 meets no picture of this film"),
    ]:
        assert main([*words, *few, *more]) == 2
        assert why in capsys.readouterr().err
