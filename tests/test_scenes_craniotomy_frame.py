"""Craniotomy frame of the built-in scenes on a head of another shape: a long ellipsoid opened on the left."""

import numpy as np
import pytest
from balls import ball

from scenes.cli import main
from scenes.play.stage import Stage
from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.scene import SCENES, find_scene
from sim.bodies.meshfile import read_anatomy
from sim.compile import check_causes
from sim.geometry.closest_point import find_closest_points
from sim.loads import Pushed

LONG = np.array([0.8, 1.25, 0.9])
"""Over a ball: narrow, long and flat."""
PLACE = "-40,18,12"
"""Of the opening [mm, RAS]."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("head")
    ball(folder, LONG)
    words = ["--mask", folder / "labels.nii.gz", "--nodes", 2000, "--radius", 9, f"--opening-at={PLACE}"]
    words += [f"--tumour-at={PLACE.replace('-40', '-22')}", "--out", folder / "long.vtu"]
    assert main(["anatomy", *map(str, words)]) == 0
    return build_craniotomy_frame(read_anatomy(folder / "long.vtu"))


def test_craniotomy_frame_is_at_requested_site_pointing_inwards(site):
    middle = site.anatomy.mesh.nodes.mean(axis=0)
    assert np.linalg.norm(site.origin - 1e-3 * np.array([-42.0, 18.0, 12.0])) < 6e-3
    assert site.axis @ (middle - site.origin) > 0.02 and site.axis[0] > 0.9
    assert site.clearance > 15e-3


@pytest.mark.parametrize("name", SCENES)
def test_scenes_act_on_open_cortex_of_another_head(name, site):
    scene, cortex = find_scene(name), site.anatomy.mesh.nodes[site.anatomy.open_surface]
    check_causes(scene.get_effects_on(site.anatomy), scene.build_loads(site, scene.path(0.0), 0.0))
    stage = Stage(scene, site)
    for time in scene.times[:: len(scene.times) // 4]:
        touch = scene.path(time)
        loads = scene.build_loads(site, touch, float(time))
        left = stage.select_stage(loads).anatomy
        assert 0 < len(left.mesh.tets) <= len(site.anatomy.mesh.tets)
        for pushed in loads.get_all(Pushed):
            away = np.linalg.norm(find_closest_points(pushed.point, cortex).point - pushed.point, axis=1)
            assert away.max() < 1e-9 and (pushed.force @ site.axis >= -1e-12).all()
        if scene.tool is None:
            continue
        pose = scene.compute_pose(site, touch)
        tip, shaft = pose[:3, 3], pose[:3, 2]
        assert shaft @ site.axis < 0.0 and np.linalg.norm(find_closest_points(tip[None], cortex).point[0] - tip) < 20e-3
