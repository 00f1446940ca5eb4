"""Validation of episodes: complete ones pass, and each defect is named."""

import h5py
import numpy as np
import pytest
from tiny_episodes import packed

from scenes.episodes.reading.repeated_frames import solve_frames_again
from scenes.episodes.reading.validation import validate_episode


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
        r"'segmentation' of frame 2 has labels [9] without a name",
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


def test_complete_episode_passes_with_its_figures(whole):
    report = validate_episode(whole)
    assert report.problems == [] and not [words for words in report.skipped if "silhouettes" in words]
    assert (report.frames, report.solved, report.unsolved) == (7, 4, 0)
    assert report.error_mm == pytest.approx((0.1, 0.1))


@pytest.mark.parametrize("name", WRONG)
def test_each_defect_of_an_episode_is_reported(name, whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    (tmp_path / "bodies").symlink_to(whole.parent / "bodies")
    how, words = WRONG[name]
    with h5py.File(path, "a") as file:
        how(file)
    problems = validate_episode(path).problems
    assert len(problems) == 1 and words in problems[0]


def test_episode_without_plan_is_not_solved_again(whole):
    report = solve_frames_again(validate_episode(whole), 2, "cpu")
    assert not report.problems and any("solved again: it states no" in words for words in report.skipped)
    assert report.again == 0 and report.again_mm is None


def test_mask_check_without_anatomy_is_reported_as_skipped(whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    report = validate_episode(path)
    assert not report.problems and any("anatomy is neither" in words for words in report.skipped)
