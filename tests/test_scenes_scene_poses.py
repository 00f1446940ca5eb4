import numpy as np
import pytest

from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.scene import find_scene
from scenes.script.scene_poses import sample_scene_poses
from scenes.script.shipped_files import get_template_path
from scenes.script.tool_paths import Touch
from sim.bodies.meshfile import read_anatomy
from sim.errors import InputError
from sim.loads import Touching
from surrogate.data.strokes import STROKE_LENGTH


@pytest.fixture(scope="module")
def site():
    return build_craniotomy_frame(read_anatomy(get_template_path()))


def test_sampled_poses_cover_the_range_of_manual_control(site):
    scene = find_scene("spatula")
    tool, loads = sample_scene_poses(scene, site, 64, 0)
    assert tool == scene.tool.shape
    pose = loads.get(Touching).pose[:, 0]
    still = scene.compute_pose(site, Touch())
    assert np.allclose(pose[:, :3, :3], still[:3, :3])  # a hand turns no blade
    depth = (pose[:, :3, 3] - still[:3, 3]) @ site.axis
    assert 0.010 < depth.max() < 0.0125 and depth.min() > -0.002
    aside = np.linalg.norm(
        pose[:, :3, 3] - site.origin - np.outer((pose[:, :3, 3] - site.origin) @ site.axis, site.axis), axis=1
    )
    reach = site.compute_reach(scene.tool.radius)
    assert aside.max() <= reach + 1e-9 and aside.max() > 0.8 * reach


def test_larger_pose_sample_starts_with_the_smaller_sample(site):
    scene = find_scene("spatula")
    few, more = (
        sample_scene_poses(scene, site, count, 3)[1].get(Touching).pose
        for count in (STROKE_LENGTH, 3 * STROKE_LENGTH + 1)
    )
    assert np.array_equal(few, more[:STROKE_LENGTH]) and not np.allclose(more[0], more[STROKE_LENGTH])
    assert not np.allclose(few, sample_scene_poses(scene, site, STROKE_LENGTH, 4)[1].get(Touching).pose)


def test_scene_without_moved_tool_is_rejected(site):
    with pytest.raises(InputError, match="the scene press moves no ball"):
        sample_scene_poses(find_scene("press"), site, 8, 0)
