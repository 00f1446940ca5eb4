"""Synthetic videos as files: time stamps in the pixels, and ground truth."""

import csv
import json

import cv2
import numpy as np
import pytest
from theatres import template_theatre

from ar.tracking.image_sequences import read_video
from ar.tracking.synthetic_images import CELL_SIDE, STRIP_WIDTH, read_time_stamp, stamp_time
from scenes.cli import main
from scenes.script.scene import find_scene
from scenes.tracked.calibration_file import read_intrinsic_covariance, write_calibration
from scenes.tracked.filming import USUAL_CALIBRATION
from scenes.tracked.registration_file import read_registration
from scenes.tracked.tracked_tool import read_tool
from scenes.tracked.truth import read_truth
from sim.errors import InputError
from sim.tools import Ball

SMALL = USUAL_CALIBRATION.resize_calibration(800, 600, allow_scaling=True)


def test_time_stamp_is_read_despite_noise_and_absent_otherwise():
    random = np.random.default_rng(0)
    picture = random.integers(0, 256, (100, 500), np.uint8)
    assert read_time_stamp(picture) is None and read_time_stamp(picture[:4]) is None
    for time in (0.0, 1.2345, 86_400.0):
        written = stamp_time(picture, time)
        np.testing.assert_array_equal(written[CELL_SIDE:], picture[CELL_SIDE:])
        worn = cv2.GaussianBlur(written, (0, 0), 1.0) + random.normal(0.0, 10.0, written.shape)
        assert read_time_stamp(np.clip(worn, 0, 255).astype(np.uint8)) == pytest.approx(time)
    for cell in range(4, 44):  # a bit that is read wrongly is noticed
        broken = stamp_time(picture, 1.2345)
        part = broken[
            :CELL_SIDE, -STRIP_WIDTH + CELL_SIDE * cell : broken.shape[1] - STRIP_WIDTH + CELL_SIDE * (cell + 1)
        ]
        part[:] = 255 - part
        assert read_time_stamp(broken) is None
    with pytest.raises(ValueError, match="0 to"):
        stamp_time(picture, -1.0)
    with pytest.raises(ValueError, match="a time needs"):
        stamp_time(picture[:, :100], 1.0)


def test_synthetic_video_is_written_with_its_ground_truth(tmp_path, capsys):
    write_calibration(tmp_path / "k.yaml", SMALL)
    out = tmp_path / "film"
    words = ["film", "press", "--deformer", "series-gp", "--camera", str(tmp_path / "k.yaml"), "--out", str(out)]
    few = ["--seconds", "0.7", "--every", "10", "--device", "cpu"]
    assert main([*words, *few, "--png", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["frames"] == 3 and said["tumour_moves_mm"] > 0.01
    theatre = template_theatre()
    stage = theatre.build_stage(find_scene("press"))
    truth = read_truth(out / "truth.npz", theatre.anatomy.digest, len(stage.tumour_vertices))
    assert truth.find_image(1.0 / 3.0) == 1 and truth.find_image(0.1) is None
    pictures = list(read_video(out / "frames", 3.0, with_colour=True))
    assert [read_time_stamp(each.grey) for each in pictures] == pytest.approx(truth.times, abs=1e-4)
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
        (["--trouble", "gap:0-9"], "no image would be recorded"),
        (["--trouble", "tool:30-40"], "tool:30-40 contains no image of this video"),
        (["--within-time", "5", "--force"], "leaves a budget nothing to choose"),
    ]:
        assert main([*words, *few, *more]) == 2
        assert why in capsys.readouterr().err
