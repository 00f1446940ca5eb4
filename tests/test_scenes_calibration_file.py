"""Calibration files: round trip, and rejected files with path, reason and remedy."""

import os

import pytest

from ar.optics.calibration import MAX_TEXT_LENGTH, Calibration
from ar.optics.lens import Lens
from scenes.tracked.calibration_file import read_calibration, write_calibration
from sim.errors import InputError

SOME = Calibration((820.5, 818.25), (321.0, 236.5), 640, 480, Lens(-0.31, 0.12, 1e-3, -2e-3, -0.02), "left")


@pytest.mark.parametrize("form", ["opencv", "ros"])
def test_calibration_file_round_trips(tmp_path, form):
    path = tmp_path / "camera.yaml"
    write_calibration(path, SOME, form)
    assert read_calibration(path) == SOME == read_calibration(str(path))
    assert [each.name for each in tmp_path.iterdir()] == ["camera.yaml"]


def test_read_calibration_rejects_missing_and_invalid_files(tmp_path):
    wrong = tmp_path / "wrong.yaml"
    with pytest.raises(InputError, match=r"wrong\.yaml: cannot be read as a camera's calibration: no such file.* Give"):
        read_calibration(wrong)
    with pytest.raises(InputError, match="is no file"):
        read_calibration(tmp_path)
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(InputError, match="is no file"):
        read_calibration(tmp_path / "pipe.yaml")
    with pytest.raises(InputError, match="names no file"):
        read_calibration(3)  # type: ignore[arg-type]
    for content, reason in (
        (b"\xff\xfe\x00\x01", "it is no text in UTF-8. Give YAML"),
        (b"", r"wrong\.yaml: image_width is missing. Give YAML"),
        (b"#" * (4 * MAX_TEXT_LENGTH + 10), r"wrong\.yaml: it has more than"),
        (b"camera_matrix: [" + b"[" * 20000, r"wrong\.yaml: its lists are nested too deeply"),
    ):
        wrong.write_bytes(content)
        with pytest.raises(InputError, match=reason):
            read_calibration(wrong)


def test_write_calibration_rejects_bad_name_format_and_path(tmp_path):
    with pytest.raises(InputError, match=r"written as \.yaml or \.yml"):
        write_calibration(tmp_path / "camera.xml", SOME)
    with pytest.raises(InputError, match="opencv or ros, not as 'matlab'"):
        write_calibration(tmp_path / "camera.yaml", SOME, "matlab")  # type: ignore[arg-type]
    (tmp_path / "camera.yaml").mkdir()
    with pytest.raises(InputError, match="folder"):
        write_calibration(tmp_path / "camera.yaml", SOME)
