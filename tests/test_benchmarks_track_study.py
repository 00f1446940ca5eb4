"""Study of tracking: its statistics and its command."""

import json

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.studies.track_study import (
    AWAY,
    LEANING,
    TIP_DISTANCE,
    TURNED,
    TrackedImage,
    build_pivot_poses,
    build_row,
    build_trial_camera,
    compute_distance_errors,
    sample_poses,
)


def shot(tip, off=None, deviation=1e-3, markers=30.0):
    """A picture whose tip was found off by (3,) [m]; None: it was not found."""
    found = None if off is None else np.array(tip) + off
    return TrackedImage(np.array(tip, float), markers, found, None if off is None else deviation**2 * np.eye(3), 0.01)


def test_row_counts_detections_and_errors():
    shots = [shot([0, 0, 0], [1e-3, 0, 0]), shot([0, 0, 0], [0, 2e-3, 0]), shot([0, 0, 0]), shot([0, 0, 0], markers=10)]
    row = build_row(
        "trial", shots, lambda certain: np.array([np.linalg.norm(each.estimate - each.true_tip) for each in certain])
    )
    assert (row.pictures, row.median, row.most) == (4, pytest.approx(1.5), pytest.approx(2.0))
    assert row.certain == pytest.approx(100.0 * 2 / 3) and row.wrong == 0 and row.held == 100.0
    bad = build_row("trial", [*shots, shot([0, 0, 0], [0, 0, 6e-3])], lambda certain: np.zeros(len(certain)))
    assert bad.wrong == 1 and bad.held == pytest.approx(100.0 * 2 / 3) and bad.milliseconds == pytest.approx(10.0)


def test_relative_error_ignores_a_common_offset():
    shots = [shot([k * 0.01, 0.0, 0.0], [1e-3, 1e-3, 0.0]) for k in range(4)]
    np.testing.assert_allclose(compute_distance_errors(shots), 0.0, atol=1e-12)
    shots.append(shot([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
    assert compute_distance_errors(shots)[-1] > 0.9e-3


def test_generated_poses_satisfy_the_protocols():
    """All poses are in view and within the tilt limit; in pivot protocols the tip is the same in every pose."""
    camera, evenly = build_trial_camera(), list(sample_poses(40, 0))
    middle = np.mean([T[:3, 3] for T in evenly], axis=0)
    np.testing.assert_allclose(middle, [0.0, 0.0, AWAY], atol=0.01)
    pixels = camera.project(np.array([T[:3, 3] for T in evenly]))[0]
    assert (pixels > 0.0).all() and (pixels < [camera.width, camera.height]).all()
    once, often = (np.array(list(build_pivot_poses(20, 0, point))) for point in (np.zeros(3), None))
    tips = once[:, :3, :3] @ [0.0, 0.0, -TIP_DISTANCE] + once[:, :3, 3]
    np.testing.assert_allclose(tips, tips[:1].repeat(20, axis=0), atol=1e-12)
    assert np.ptp(often[:, :3, :3] @ [0.0, 0.0, -TIP_DISTANCE] + often[:, :3, 3], axis=0).min() > 0.03
    for poses, most in ((evenly, TURNED), (once, LEANING)):
        cosine = [0.5 * (np.trace(T[:3, :3] @ first_turn(poses).T) - 1.0) for T in poses]
        assert np.degrees(np.arccos(min(cosine))) <= 2.0 * most
    assert not np.allclose(list(sample_poses(5, 1)), evenly[:5])


def first_turn(poses):
    """The first rotation (3, 3)."""
    return poses[0][:3, :3]


def test_track_command_prints_a_row_for_each_protocol(capsys):
    assert main(["track", "--pictures", "2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 3 and all(row["wrong"] == 0 and row["certain"] in (100.0, None) for row in rows)
    assert all(row["most"] < 1.5 for row in rows)
    assert main(["track", "--pictures", "1"]) == 2
    assert "--pictures" in capsys.readouterr().err
