"""Synthetic videos of a scene: targets, disturbances and registration errors."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from theatres import template_theatre

from ar.tracking.pose import Tracker
from ar.tracking.synthetic_images import read_time_stamp
from ar.tracking.targets import Detector, build_patient_reference, build_tool_cube
from scenes.play.deformers import RestDeformer
from scenes.play.player import Player
from scenes.script.scene import find_scene
from scenes.tracked.filming import (
    USUAL_CALIBRATION,
    VIEW,
    Artefacts,
    Disturbance,
    mount_targets,
    register_with_error,
    render_frames,
)
from sim.errors import InputError

SMALL = USUAL_CALIBRATION.resize_calibration(800, 600, allow_scaling=True)


TARGETS = (build_tool_cube(), build_patient_reference())


@pytest.fixture(scope="module")
def player():
    """The scene palpate on a brain that stays at rest."""
    theatre = template_theatre()
    scene = replace(find_scene("palpate"), viewpoint=VIEW.calibrate(SMALL), duration=0.7)
    return Player(theatre.build_stage(scene), RestDeformer(theatre.anatomy))


@pytest.fixture(scope="module")
def shots(player):
    """Seven pictures, with a trouble of each kind but the first and the last."""
    kinds = ("reference", "tool", "bright", "smear", "gap")
    troubles = tuple(Disturbance(kind, 0.1 * n + 0.05, 0.1 * n + 0.15) for n, kind in enumerate(kinds))
    return list(render_frames(player, mount_targets(player), Artefacts(disturbances=troubles), step=3))


def grey(shot):
    return cv2.cvtColor(shot.image, cv2.COLOR_RGB2GRAY)


def test_both_targets_are_tracked_at_their_true_poses(player, shots):
    mounts = mount_targets(player)
    seen = Tracker(SMALL.build_camera(np.eye(4)), TARGETS).track(grey(shots[0]))
    wanted = {"tool": shots[0].T_scan_tool @ np.linalg.inv(mounts.tool.T_cube_tool), "patient": mounts.T_scan_patient}
    assert set(seen.poses) == set(wanted)
    for name, T_scan_target in wanted.items():
        off = seen.poses[name].T_camera_target - shots[0].T_camera_scan @ T_scan_target
        assert np.abs(off[:3, 3]).max() < 0.5e-3 and np.abs(off[:3, :3]).max() < 0.01
    assert len(np.unique(Detector(TARGETS).detect(grey(shots[0]))["tool"].face)) >= 2


def test_disturbances_hide_only_the_named_targets(shots):
    detector = Detector(TARGETS)
    found = [set(detector.detect(grey(shot))) for shot in shots]
    both = {"tool", "patient"}
    assert found[0] == found[-1] == both  # before and after
    assert found[1:5] == [{"tool"}, {"patient"}, set(), set()]
    assert [shot.time for shot in shots] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.7])  # 0.5 is left out
    assert [read_time_stamp(grey(shot)) for shot in shots] == pytest.approx([shot.time for shot in shots])


def test_invalid_disturbance_is_rejected():
    with pytest.raises(InputError, match="no trouble is called 'fog'"):
        Disturbance("fog", 0.0, 1.0)
    with pytest.raises(InputError, match="two times in order"):
        Disturbance("gap", 1.0, 0.5)


def test_registration_error_has_the_reported_covariance(player):
    mounts, found = mount_targets(player), []
    for seed in range(200):
        one = register_with_error(player.site, mounts, 0.5, 0.4, seed)
        off = one.T_patient_scan @ mounts.T_scan_patient
        place, covariance = one.transform_point(player.site.origin + [0.02, 0.0, 0.0])
        true = np.linalg.inv(mounts.T_scan_patient) @ [*(player.site.origin + [0.02, 0.0, 0.0]), 1.0]
        found.append((place - true[:3]) @ np.linalg.solve(covariance, place - true[:3]))
        assert not np.allclose(off, np.eye(4), atol=1e-6)
    assert np.mean(found) == pytest.approx(3.0, rel=0.2)
    exact = register_with_error(player.site, mounts, 0.0, 0.0, 0).T_patient_scan
    np.testing.assert_allclose(exact, np.linalg.inv(mounts.T_scan_patient), atol=1e-12)
