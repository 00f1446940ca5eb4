"""Episodes looked at before they are trusted: whole ones pass, and each thing that is wrong is named."""

import json
import os
import signal
import time

import h5py
import numpy as np
import pytest
from tiny_episodes import Wanted, packed, write_episode

from scenes import write_card
from scenes.cli import main
from scenes.episodes.checksums import seal
from scenes.episodes.reading.again import solved_again, validated
from scenes.episodes.reading.validation import Report, validate_episode


def changed(name, rows):
    def how(file):
        values = file[name][:]
        rows(values)
        file[name][...] = values

    return how


def set_picture(name, frame, code):
    return lambda file: file[f"pictures/{name}"].__setitem__(frame, code)


def shift_mask(file):
    store = file["pictures/tumour_mask"]
    store[0] = packed("tumour_mask", np.zeros((30, 40), np.uint8))


def rename_unit(file):
    file["force"].attrs["unit"] = "mN"


WRONG = {
    "unit": (rename_unit, "'force' has the unit 'mN' in place of 'N'"),
    "nan": (
        changed("tumour_predicted", lambda x: x.__setitem__((3, 1, 2), np.nan)),
        "'tumour_predicted' has a number in row 3",
    ),
    "infinite": (changed("distance", lambda x: x.__setitem__(2, np.inf)), "'distance' has a number in row 2"),
    "time": (changed("time", lambda x: x.__setitem__(4, 0.0)), "'time' does not grow from row 3 to row 4"),
    "pose": (
        changed("T_world_tool", lambda x: x.__setitem__((5, 0, 0), 2.0)),
        "'T_world_tool' of row 5 is no rotation",
    ),
    "camera": (changed("K", lambda x: x.__setitem__((0, 0), -1.0)), "'K' is no matrix of a camera"),
    "label": (
        set_picture("segmentation", 2, packed("labels", np.full((30, 40), 9, np.uint8))),
        r"'segmentation' of frame 2 has labels [9] that nothing names",
    ),
    "size": (
        set_picture("colour", 1, packed("colour", np.zeros((60, 80, 3), np.uint8))),
        "'colour' of frame 1 cannot be decoded: it has 80 x 60 pixels in place of 40 x 30",
    ),
    "bytes": (
        set_picture("depth", 6, np.arange(50, dtype=np.uint8)),
        "'depth' of frame 6 cannot be decoded: it is neither",
    ),
    "silhouette": (shift_mask, "'tumour_mask' of frame 0 differs in"),
    "solved": (
        changed("fem_frames", lambda x: x.__setitem__(1, 40)),
        "'fem_frames' are not sorted numbers of its 7 frames",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def whole(box, tmp_path_factory):
    return write_episode(tmp_path_factory.mktemp("whole") / "episode_000000.h5", box, Wanted(7, every=2))


def test_what_is_whole_passes_with_its_figures(whole):
    report = validate_episode(whole)
    assert report.problems == [] and not [words for words in report.skipped if "silhouettes" in words]
    assert (report.frames, report.solved, report.unsolved) == (7, 4, 0)
    assert report.error_mm == pytest.approx((0.1, 0.1))


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name, whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    (tmp_path / "bodies").symlink_to(whole.parent / "bodies")
    how, words = WRONG[name]
    with h5py.File(path, "a") as file:
        how(file)
    problems = validate_episode(path).problems
    assert len(problems) == 1 and words in problems[0]


def test_content_that_is_not_what_was_written_is_named(whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "a") as file:
        seal(file)
    assert validate_episode(path).problems == [] and "checksums: it states none" not in validate_episode(path).skipped
    with h5py.File(path, "a") as file:
        file["force"][2, 1] += 1e-9
    assert validate_episode(path).problems == ["/force: is not as it was written."]


def test_arrays_that_are_gone_or_came_later_are_named(whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "a") as file:
        seal(file)
        del file["force"], file["pictures/depth"]
        file["tip"][2, 1] += 1e-9
        file["late"] = [1.0]
    gone = "is gone; it was there when the file was written."
    assert validate_episode(path).problems == [
        f"/force: {gone}",
        f"/pictures/depth: {gone}",
        "/late: was not there when the file was written.",
        "/tip: is not as it was written.",
    ]
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "a") as file:
        seal(file)
        file["force"].attrs["note"] = "mine"
    assert validate_episode(path).problems == ["attributes are not as they were written."]


def test_frames_are_not_solved_again_without_a_plan(whole):
    report = solved_again(validate_episode(whole), 2, "cpu")
    assert not report.problems and any("solved again: it states no" in words for words in report.skipped)
    assert report.again == 0 and report.again_mm is None


def test_a_mask_without_its_anatomy_is_said_to_be_skipped(whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    report = validate_episode(path)
    assert not report.problems and any("anatomy is neither" in words for words in report.skipped)


def test_the_command_names_broken_files_and_ends_with_one(whole, tmp_path, capsys):
    broken = tmp_path / "broken.h5"
    broken.write_bytes(whole.read_bytes()[:3000])
    assert main(["validate", str(whole), "--workers", "1"]) == 0
    out = capsys.readouterr().out
    assert "1 of 1 episodes are whole: 7 frames, 4 of them solved" in out and "0.100 mm at most" in out
    assert main(["validate", str(whole), str(broken), "--workers", "1", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["broken"] == 1 and said["files"][1]["path"] == str(broken)
    size, (problem,) = whole.stat().st_size, said["files"][1]["problems"]
    assert f"cannot be read as an episode: it is cut off: 3000 of {size} bytes. Make it anew" in problem
    assert "sulcus validate" not in problem
    with h5py.File(broken, "w") as file:
        file.attrs.update({"format": "sulcus episode 2", "width": 40, "height": 30})
    assert validate_episode(broken).problems == ["it has no 'time'. Make it anew, or leave it out."]
    assert main(["validate", str(tmp_path / "none.h5")]) == 2 and "no such file" in capsys.readouterr().err
    assert main(["validate", str(whole), "--workers", "0"]) == 2


def test_figures_are_of_whole_episodes_and_what_the_card_names_is_missed(box, tmp_path, capsys):
    for number in range(3):
        write_episode(tmp_path / f"episode_00000{number}.h5", box, Wanted(4 + number, every=1))
    with h5py.File(tmp_path / "episode_000000.h5", "a") as file:
        file["tumour_fem"][...] = file["tumour_predicted"][:] + [0.0, 0.0, 2e-7]
    with h5py.File(tmp_path / "episode_000001.h5", "a") as file:
        file["force"].attrs["unit"] = "mN"
    write_card(tmp_path)
    (tmp_path / "episode_000002.h5").unlink()
    assert main(["validate", str(tmp_path), "--workers", "1"]) == 1
    unit, gone, *_, frames, error = capsys.readouterr().out.splitlines()
    assert "'mN'" in unit and "episode_000002.h5: is gone; episodes.csv names it" in gone
    assert "1 of 3 episodes are whole: 4 frames, 4 of them solved" in frames
    assert "0.000200 mm on average, 0.000200 mm at most" in error


def slow(path):
    """What takes long."""
    time.sleep(0.5)
    return Report(path)


def test_who_wants_no_more_waits_for_what_has_begun_alone(tmp_path):
    reports = validated([tmp_path / f"{number}.h5" for number in range(200)], 1, slow)
    assert next(reports).problems == []
    began = time.perf_counter()
    reports.close()
    assert time.perf_counter() - began < 20.0  # of a hundred seconds


def end(path):
    """What a damaged file may do to the library that reads it."""
    if "broken" in path.name:
        os.kill(os.getpid(), signal.SIGKILL)
    return validate_episode(path)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_file_that_ends_its_reader_ends_no_other(whole, tmp_path):
    broken = tmp_path / "broken.h5"
    broken.write_bytes(whole.read_bytes())
    reports = {report.path: report for report in validated([broken, whole], 1, end)}
    assert "ends the process that reads it" in reports[broken].problems[0] and not reports[whole].problems
