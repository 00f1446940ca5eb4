"""Rejected videos of another camera or of another zoom."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from films import FILM

from scenes.cli import main
from scenes.tracked.calibration_file import read_calibration, write_calibration
from scenes.tracked.video_camera import check_video


@pytest.mark.parametrize(("factor", "way"), [(1.15, "13% shorter"), (0.85, "18% longer")])
def test_video_of_another_zoom_is_rejected_before_tracking(factor, way, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "scenes.tracked.external_tracker.track_video", lambda *given: pytest.fail("the whole film is followed")
    )
    calibration = read_calibration(FILM / "camera.yaml")
    path = tmp_path / "camera.yaml"
    write_calibration(path, replace(calibration, focal=tuple(factor * each for each in calibration.focal)))
    given = [str(FILM / "film.mp4"), "--camera", str(path)]
    for words in (["track", *given, "--out", str(tmp_path / "poses.csv")], ["overlay", *given]):
        words += ["--registration", str(FILM / "registration.json")] if words[0] == "overlay" else []
        assert main(words) == 2
        said = capsys.readouterr().err
        assert said.splitlines()[-1].startswith(f"sulcus {words[0]}: {FILM / 'film.mp4'}: its markers are seen with ")
        assert f"focal lengths that are {way}" in said and f"than {path} states" in said
        assert "calibrate this one" in said
    assert list(tmp_path.iterdir()) == [path]
    check_video(FILM / "film.mp4", 30.0, calibration, "the film's own")
    nearly = replace(calibration, focal=tuple(1.02 * each for each in calibration.focal))
    check_video(FILM / "film.mp4", 30.0, nearly, "two per cent off")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "it is empty"),
        (b"no video", "its bytes are not a video's"),
        ((FILM / "film.mp4").read_bytes()[:2000], "it is cut off or damaged"),
    ],
)
def test_unreadable_video_is_rejected_with_reason(content, why, tmp_path, capsys):
    (tmp_path / "short.mp4").write_bytes(content)
    given = [str(tmp_path / "short.mp4"), "--camera", str(FILM / "camera.yaml")]
    assert main(["track", *given, "--out", str(tmp_path / "poses.csv")]) == 2
    assert capsys.readouterr().err == (
        f"sulcus track: {tmp_path}/short.mp4: is not a readable video, as {why}: give a video, or a folder of PNG "
        "or JPEG images.\n"
    )


def test_unreadable_video_gives_no_library_output(tmp_path):
    """In a new process: FFmpeg reads its log level once."""
    (tmp_path / "short.mp4").write_text("no video")
    code = (
        "import pathlib, sys; from ar.tracking.image_sequences import read_frame_rate; "
        "read_frame_rate(pathlib.Path(sys.argv[1]))"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "short.mp4")]
    done = subprocess.run(words, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True)
    assert done.stdout == done.stderr == ""
