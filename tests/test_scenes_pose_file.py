"""Pose files: rows, counts and units."""

import numpy as np
import pytest
from test_scenes_calibrate import HEAD, turned, write_poses

from scenes.tracked.pose_file import read_poses
from sim.errors import InputError


def test_unseen_pose_rows_of_each_kind_are_counted(tmp_path):
    path, good = tmp_path / "poses.csv", "1,2,3,0,0,0,1"
    poses = [good, good, good, "nan,nan,nan,nan,nan,nan,nan", "0,0,0,0,0,0,0", "0,0,0,0,0,0,1", good]
    cells = ["OK", "MISSING", "OUT_OF_VIEW", "OK", "OK", "OK", "OK"]
    rows = [f"{row},{pose},{cell}" for row, (pose, cell) in enumerate(zip(poses, cells, strict=True))]
    path.write_text("\n".join([f"{HEAD},status", *rows]))
    with pytest.warns(UserWarning, match="5 rows are not seen") as caught:
        read_poses(path)
    parts = str(caught[0].message).rpartition(": ")[2].split(", ")
    assert sum(int(part.split()[0]) for part in parts) == 5 and parts[-1] == "2 other"


@pytest.mark.parametrize(
    ("column", "cells", "pose"),
    [
        ("Status", ("OK", "MISSING", "OUT_OF_VIEW"), None),
        ("ToolToTrackerTransformStatus", ("ok", "INVALID", "ok"), None),
        ("valid", ("1", "0", "False"), None),
        ("state", ("good", "", "Partially Out of Volume"), None),
        ("status", ("OK", "MISSING", "OK"), "nan,nan,nan,nan,nan,nan,nan"),
        ("note", ("a", "b", "c"), "nan,nan,nan,nan,nan,nan,nan"),
        ("note", ("a", "b", "c"), "0,0,0,0,0,0,0"),
        ("note", ("a", "b", "c"), "0,0,0,0,0,0,1"),
    ],
)
def test_unseen_pose_rows_are_removed_and_counted(tmp_path, column, cells, pose):
    path, good = tmp_path / "poses.csv", "1,2,3,0,0,0,1"
    rows = [f"{row},{good if row != 1 or pose is None else pose},{cell}" for row, cell in enumerate(cells)]
    path.write_text("\n".join([f"{HEAD},{column}", *rows]))
    unseen = len({"MISSING", "INVALID", "0", ""}.intersection(cells) or {pose}) + len(
        {"OUT_OF_VIEW", "False", "Partially Out of Volume"}.intersection(cells)
    )
    with pytest.warns(UserWarning, match=f"{unseen} rows are not seen by the tracker"):
        assert len(read_poses(path)[0]) == 3 - unseen
    path.write_text(f"{HEAD}\n0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1\n")
    assert len(read_poses(path)[0]) == 2  # the tracker's own frame


def test_read_poses_returns_metres_and_rejects_invalid_rows(tmp_path):
    path = write_poses(tmp_path / "poses.csv", turned(3), [[0.1, 0.2, 0.3]] * 3)
    _, times, found = read_poses(path)
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2])
    np.testing.assert_allclose(found[:, :3, 3], [[0.1, 0.2, 0.3]] * 3)
    np.testing.assert_allclose(found[:, :3, :3], turned(3).as_matrix(), atol=1e-12)
    good = "0,1,2,3,0,0,0,1\n"
    for text, reason in (
        (f"{HEAD[7:]}\n{good[2:]}", "give the header time_s,x_mm"),
        (f"{HEAD},qw\n", "give the header"),
        (f"{HEAD}\n{good}{good}", "row 3 is not later than the row before"),
        (f"{HEAD}\n{good[:-2]}2\n", "row 2 has a quaternion of length 2: give qx"),
        (f"{HEAD}\n{good[:-2]}0\n", "row 2 has a quaternion of length 0"),
        (f"{HEAD}\n0,1,2,nan,0,0,0,1\n", "row 2 has a number that is not finite"),
        (f"{HEAD}\n0,1,2,1e6,0,0,0,1\n", "row 2 is farther than 100 m"),
        (f"{HEAD}\n0,1,2\n", "row 2 is '0,1,2', not 8 numbers"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=reason):
            read_poses(path)
    with pytest.raises(InputError, match="no such file"):
        read_poses(tmp_path / "none.csv")
