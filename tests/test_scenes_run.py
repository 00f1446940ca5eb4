"""Masks of objects in front of the brain in a real image: no overlay there, and the covered share is reported."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from theatres import template_theatre

from ar.overlay.hud import TEXT_SCALE
from ar.overlay.outlines import average_colour, compute_silhouette, find_colour, has_text
from ar.screen import write_movie
from ar.tracking.image_sequences import NamedImage, read_video
from scenes.cli import main
from scenes.script.scene import find_scene
from scenes.tracked.calibration_file import read_calibration
from scenes.tracked.follower import Follower
from scenes.tracked.overlay_painter import Painter
from scenes.tracked.registration_file import read_registration
from scenes.tracked.run import draw_overlays, read_timed_images
from scenes.tracked.tool_motion import ToolMotion

FILM = Path(__file__).parent / "data" / "film"


@pytest.fixture(scope="module")
def parts():
    stage = template_theatre().build_stage(find_scene("palpate"))
    calibration, registration = read_calibration(FILM / "camera.yaml"), read_registration(FILM / "registration.json")
    return Follower(calibration, registration, None, ToolMotion(stage, None)), Painter(stage, None, "contour")


def film(count):
    return islice(read_video(FILM / "film.mp4", 30.0, with_colour=True), count)


def test_masked_areas_have_no_overlay_and_report_their_share(parts):
    follower, painter = parts
    (whole,) = draw_overlays(read_timed_images(film(1)), follower, painter)
    camera, tumour = whole.result.camera, painter.stage.tumour_at_rest
    mask = compute_silhouette(camera, tumour.vertices, tumour.triangles)
    columns = np.flatnonzero(mask.any(axis=0))
    covered = np.zeros(mask.shape, np.uint8)
    covered[150:, : int(columns.mean())] = 255  # below the words of the head
    (hidden,) = draw_overlays(read_timed_images(film(1), iter([NamedImage("0.png", covered)])), follower, painter)
    amber = [find_colour(each.image, average_colour((0.92, 0.50, 0.05))) for each in (whole, hidden)]
    assert amber[0][covered > 0].any() and not amber[1][covered > 0].any()
    np.testing.assert_array_equal(amber[0][covered == 0], amber[1][covered == 0])
    share = np.count_nonzero(mask & (covered > 0)) / np.count_nonzero(mask)
    assert 0.2 < share < 0.8
    assert has_text(hidden.image, f"{share:.0%} of the tumour is behind what lies in front", TEXT_SCALE)
    assert hidden.result.bound == whole.result.bound and not hidden.result.is_reliable


def test_frozen_overlay_is_hidden_by_the_mask(parts):
    follower, painter = parts
    (shown,) = draw_overlays(read_timed_images(film(1)), follower, painter)
    blank = np.full(shown.image.shape, 120, np.uint8)
    lost = follower.track(blank[..., 0], 0.1, shown.result)
    covered = np.zeros(blank.shape[:2], bool)
    covered[:600] = True
    assert (painter.paint(blank, lost).colour[:600] != 120).any()
    assert (painter.paint(blank, lost, covered).colour[:600] == 120).all()


def test_masks_match_images_by_number_and_size():
    black = NamedImage("a.png", np.zeros((720, 960), np.uint8))
    assert [each.occluded.any() for each in read_timed_images(film(2), iter([black, black]))] == [False, False]
    ones = black.grey.copy()
    ones[100:200] = 1  # a mask of 0 and 1
    (shown,) = read_timed_images(film(1), iter([NamedImage("a.PNG", ones)]))
    np.testing.assert_array_equal(shown.occluded, ones > 0)
    soft = replace(black, name="frame 0", grey=np.full_like(ones, 16))  # a video's black
    assert not next(read_timed_images(film(1), iter([soft]))).occluded.any()
    with pytest.raises(ValueError, match="frame 1 has no mask"):
        list(read_timed_images(film(2), iter([black])))
    with pytest.raises(ValueError, match="more masks than images"):
        list(read_timed_images(film(1), iter([black, black])))
    with pytest.raises(ValueError, match=r"the mask b\.png"):
        list(read_timed_images(film(1), iter([NamedImage("b.png", black.grey[1:])])))


def test_overlay_command_rejects_mask_video_with_missing_frames(tmp_path, capsys):
    masks = tmp_path / "masks.mp4"
    write_movie(masks, iter([np.zeros((720, 960, 3), np.uint8)] * 2), 30.0)
    given = ["--camera", str(FILM / "camera.yaml"), "--registration", str(FILM / "registration.json")]
    assert main(["overlay", str(FILM / "film.mp4"), *given, "--covered", str(masks)]) == 2
    assert "frame 2 has no mask: there are 2" in capsys.readouterr().err
