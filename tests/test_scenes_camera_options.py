"""Options of a scene's camera: calibration, path and eye."""

from argparse import ArgumentParser

from theatres import REAL, put

from ar.screen import read_png
from scenes.cli import main
from scenes.options import camera_options
from scenes.script.camera_paths import PATHS
from scenes.script.scene import find_scene
from scenes.tracked.calibration_file import write_calibration


def test_path_names_of_the_command_line_match_camera_paths():
    assert tuple(PATHS) == camera_options.PATHS


def test_distance_option_sets_the_viewpoint_distance_in_metres():
    camera_options.add_camera_options(parser := ArgumentParser())
    args = parser.parse_args(["--distance", "250"])
    assert camera_options.use_tracked_camera(args, find_scene("press")).viewpoint.distance == 0.25


def test_calibrated_camera_works_in_render_check_and_collect(theatre, tmp_path, capsys):
    path, out, body = tmp_path / "camera.yaml", tmp_path / "frames", put(theatre, tmp_path / "box.vtu")
    write_calibration(path, REAL, "ros")
    seen = ["--camera", str(path), "--path", "microscope", "--eye", "right", "--device", "cpu", "--anatomy", str(body)]
    assert main(["render", "press", "--out", str(out), "--every", "60", "--plain", *seen]) == 0
    pictures = sorted(out.iterdir())
    assert len(pictures) == 3 and read_png(pictures[0]).shape == (360, 480, 3)
    # Another camera's frames are another run's.
    assert main(["render", "press", "--out", str(out), "--every", "60", "--plain", *seen, "--size", "240x180"]) == 2
    assert main(["check", "press", "--every", "60", "--json", *seen]) == 0
    capsys.readouterr()
    for words, reason in (
        (["--size", "240x180"], "give both, or neither"),
        (["--camera", str(path), "--size", "240x240"], "another shape"),
        (["--camera", str(out)], "is no file"),
        (["--path", "hand-held", "--path-seed", "-1"], "not below 0"),
        (["--tilt", "80"], "from -75 to 75 degrees"),
        (["--distance", "20"], "give 50 to 1000 mm"),
    ):
        assert main(["render", "press", "--out", str(tmp_path / "none"), *words]) == 2
        assert reason in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
