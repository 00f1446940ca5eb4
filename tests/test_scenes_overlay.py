"""Overlay on a video with ground truth: outline, error band, drape and paced playback."""

import csv
import json
import time
from itertools import islice

import cv2
import numpy as np
import pytest
from films import FILM, Recorded

from ar.overlay.outlines import (
    average_colour,
    compute_changed_share,
    compute_silhouette,
    find_colour,
    measure_outline_distance,
)
from ar.rendering.layer import Layer
from ar.rendering.real_image import build_real_image
from ar.tracking.image_sequences import NamedImage, read_video
from scenes.cli import main
from scenes.play.stage import CORTEX, DRAPE, TUMOUR_COLOUR
from scenes.tracked.calibration_file import read_calibration
from scenes.tracked.follower import TumourState
from scenes.tracked.overlay_painter import Painter
from scenes.tracked.run import TimedImage, draw_overlays, pace_images, read_timed_images
from scenes.tracked.tool_motion import ToolMotion
from scenes.tracked.truth import compute_overlay_error, read_truth, summarise_errors
from sim.errors import InputError
from sim.loads import Touching
from surrogate.model.learned import build_prediction

GIVEN = ["--camera", str(FILM / "camera.yaml"), "--registration", str(FILM / "registration.json")]
GOOD, REST, LOST, TOOL, STALE = (
    TumourState.GOOD,
    TumourState.REST,
    TumourState.NO_REFERENCE,
    TumourState.NO_TOOL,
    TumourState.STALE,
)
# Of a film of palpate that is over-exposed at 0.53 s, hides the cube from 0.93 to 1.07 s and the reference from
# 1.33 to 1.73 s, and lacks a picture at 2 s. The ball lies on the cortex from 0.4 s on.
STATES = [REST, REST, REST, GOOD, LOST, GOOD, GOOD, TOOL, TOOL, GOOD, LOST, LOST, LOST, LOST, GOOD, STALE, GOOD]
INK = average_colour(TUMOUR_COLOUR)


@pytest.fixture(scope="module")
def calibration():
    return read_calibration(FILM / "camera.yaml")


def pictures():
    return read_timed_images(read_video(FILM / "film.mp4", 30.0, with_colour=True))


@pytest.fixture(scope="module")
def shown(follower, stage):
    return list(draw_overlays(pictures(), follower, Painter(stage, follower.tool, "contour")))


def test_each_image_has_its_tracking_state_and_time(shown, truth):
    assert [each.result.state for each in shown] == STATES
    assert all(each.has_stamp for each in shown)
    assert [each.result.time for each in shown] == pytest.approx(truth.times, abs=1e-4)
    assert [each.result.camera is None for each in shown].count(True) == 5  # the reference is lost for longer
    assert {each.result.warning for each in shown if each.result.is_reliable} == {""}
    assert "tool lost: the tumour as 0.1 s ago" in shown[7].result.warning
    assert "no image for 0.3 s" in shown[15].result.warning
    lost = [shown[n].result.warning for n in (4, 10, 11, 13)]
    assert lost == ["reference lost: nothing is drawn"] * 4


def test_drawn_outline_matches_the_true_tumour(shown, truth, calibration, stage, follower):
    vertices, triangles = follower.tool.mesh
    for each in shown:
        if not each.result.is_reliable:
            assert np.count_nonzero(find_colour(each.image, INK)) < 5  # nothing looks as if it were known
            continue
        row = truth.find_image(each.result.time)
        camera, pose = calibration.build_camera(truth.T_camera_scan[row]), truth.T_scan_tool[row]
        true = stage.tumour_at_rest.vertices + truth.displacement[row]
        mask = compute_silhouette(camera, true, stage.tumour_at_rest.triangles)
        covered = compute_silhouette(camera, vertices @ pose[:3, :3].T + pose[:3, 3], triangles)
        assert measure_outline_distance(each.image, INK, mask, covered) < 2.5


def test_overlay_is_not_drawn_over_the_drape(shown, truth, calibration, stage, follower):
    each, known = next(islice(pictures(), 6, None)).source, shown[6].result
    painted = Painter(stage, follower.tool).paint(each.colour, known).colour
    camera, tumour = calibration.build_camera(truth.T_camera_scan[6]), stage.build_tumour(known.motion.positions)
    seen = stage.render(camera, known.motion.positions, None).segmentation
    mask = compute_silhouette(camera, tumour.vertices, tumour.triangles)
    under, through = (
        compute_changed_share(each.colour, painted, mask & (seen == ground)) for ground in (DRAPE, CORTEX)
    )
    assert under < 0.03 and through > 0.8


def test_overlay_error_lies_within_its_error_band(shown, truth, calibration, stage):
    errors = [compute_overlay_error(each.result, truth, calibration, stage) for each in shown]
    said = summarise_errors([each.result for each in shown], errors)
    assert said["pictures"] == 9 and said["wrong"] == 0 and said["held_percent"] == 100.0
    assert said["outline_px_p95"] < 0.5 and said["overlap_least"] > 0.98
    assert said["middle_mm_p95"] < 0.15 and 0.05 < said["band_mm_p50"] < 0.4
    assert shown[4].result.bound is None and errors[4] is errors[11] is None


def test_tool_depth_error_is_propagated_to_tumour_motion(follower, truth, stage):
    class Falling(Recorded):
        def deform(self, loads, start=None, at=None):
            depth = (loads.get_only(Touching).pose[0, 0, :3, 3] - truth.T_scan_tool[5, :3, 3]) @ stage.site.axis
            moved = np.full((1, len(self.vertices), 3), 0.2 * depth / np.sqrt(3.0))
            return build_prediction(moved, self.vertices, loads, [False], 0.0, np.full((2, 1), np.nan), "")

    falling = Falling(stage.anatomy, stage.tumour_vertices, truth.T_scan_tool, truth.displacement)
    motion = ToolMotion(stage, falling).compute_motion(truth.T_scan_tool[5], np.diag([1e-8, 4e-6, 1e-8]))
    assert motion.tool_error == pytest.approx(0.2 * 1.96 * 2e-3, rel=0.01)


def test_paced_video_drops_images_at_slow_processing():
    picture = np.zeros((8, 8), np.uint8)
    film = (TimedImage(NamedImage(str(n), picture, 0.02 * n), False) for n in range(20))
    seen, ages = [], []
    for taken, begun in pace_images(film):
        ages.append(time.perf_counter() - begun - taken.source.time)
        seen.append(taken.source.name)
        time.sleep(0.05)
    assert 5 < len(seen) < 14 and seen == sorted(seen, key=int) and seen[0] == "0"
    assert min(ages) > -1e-3 and np.median(ages) < 0.03
    assert not list(pace_images(iter([])))


def test_real_image_has_layers_only_inside_the_box(calibration):
    camera = calibration.build_camera(np.eye(4))
    corners = 0.02 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    near, far = (Layer(str(n), n, corners + [0.0, 0.0, z], np.array([[0, 1, 2]])) for n, z in ((1, 0.3), (2, 0.4)))
    colour = np.random.default_rng(0).integers(0, 256, (720, 960, 3), np.uint8)
    picture = build_real_image(colour, camera, [far, near], (slice(300, 500), slice(400, 600)))
    np.testing.assert_array_equal(picture.colour, colour)
    middle = tuple(camera.project(near.vertices.mean(axis=0))[0].round().astype(int)[::-1])
    assert picture.segmentation[middle] == 1 and picture.depth[middle] == pytest.approx(0.3)
    outside = picture.segmentation.copy()
    outside[300:500, 400:600] = 0
    assert not outside.any() and {1, 2} >= set(np.unique(picture.segmentation[300:500])) - {0}
    with pytest.raises(ValueError, match="the camera"):
        build_real_image(colour[:100], camera, [], (slice(0, 1), slice(0, 1)))


def test_overlay_command_writes_video_table_and_report(tmp_path, capsys):
    out, table = tmp_path / "shown.mp4", tmp_path / "rows.csv"
    more = ["--truth", str(FILM / "truth.npz"), "--out", str(out), "--table", str(table), "--device", "cpu", "--json"]
    assert main(["overlay", str(FILM / "film.mp4"), *GIVEN, *more]) == 1  # nobody says how the brain moved
    printed = capsys.readouterr()
    said = json.loads(printed.out)
    assert "camera.json states no covariance of the camera" in printed.err
    assert said["pictures"] == 17 and said["states"][TumourState.UNKNOWN.value] == 11
    assert said["reference_seen_percent"] == pytest.approx(100.0 * 12 / 17)
    assert said["tool_seen_percent"] == 0.0 and "as in the scan" in said["motion_by"]
    assert said["latency"]["time_from"] == "pixels" and sum(said["latency"]["histogram_ms"].values()) == 17
    assert said["off"]["pictures"] == 0
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["state"] for row in rows].count("no_reference") == 5
    assert (
        rows[0]["moved_mm"] == rows[0]["within_mm"] == ""
        and "tissue motion unknown" in rows[0]["words"]
        and rows[11]["tumour_x_mm"] == ""
    )
    film = list(read_video(out, 30.0, with_colour=True))
    assert len(film) == 17 and film[0].grey.shape == (720, 960)


def test_overlay_command_rejects_incompatible_inputs(tmp_path, capsys):
    film = str(FILM / "film.mp4")

    def refused(*words, film=film):
        assert main(["overlay", film, *GIVEN, *words, "--device", "cpu"]) == 2
        return capsys.readouterr().err

    assert "give --tool TOOL.json" in refused("--deformer", "fem")
    tool = "--tool", str(FILM / "tool.json")
    assert "no deformer is called 'bogus' here: choose one of fem, rest." in refused(*tool, "--deformer", "bogus")
    assert "unsupported video type" in refused("--out", str(tmp_path / "x.avi"))
    assert "--rate 0" in refused("--rate", "0")
    assert "no such file" in refused(film=str(tmp_path / "none.mp4"))
    (tmp_path / "text.mp4").write_text("no video")
    assert "not a readable video" in refused(film=str(tmp_path / "text.mp4"))
    small = tmp_path / "small"
    small.mkdir()
    cv2.imwrite(str(small / "a.png"), np.zeros((360, 480, 3), np.uint8))
    out = tmp_path / "none.mp4"
    assert "calibrate it at this size" in refused("--out", str(out), film=str(small))
    assert not list(tmp_path.glob("*none*"))
    # What is quickly read is read before anatomy and models.
    assert "calibrate it at this size" in refused("--model", str(small / "a.png"), film=str(small))
    assert "none.vtu: no such file" in refused("--anatomy", str(tmp_path / "none.vtu"))
    stored = json.loads((FILM / "registration.json").read_text())
    made = {"anatomy": "another", "bounds_mm": [[0, 0, 0], [9, 9, 9]], "tumour_mm": [1, 2, 3]}
    (tmp_path / "r.json").write_text(json.dumps(stored | {"scanned": made}))
    assert "was made for another anatomy" in refused("--registration", str(tmp_path / "r.json"))
    blank = tmp_path / "blank"
    blank.mkdir()
    cv2.imwrite(str(blank / "a.png"), np.full((720, 960, 3), 120, np.uint8))
    assert main(["overlay", str(blank), *GIVEN, "--device", "cpu"]) == 1  # nothing is known
    with pytest.raises(InputError, match="cannot be read as the ground truth of a video"):
        read_truth(tmp_path / "text.mp4", "", 0)
