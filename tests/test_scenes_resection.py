"""Resection of a tumour in steps: removed elements, remaining tumour in images, episodes and on the page."""

from dataclasses import replace
from itertools import pairwise

import h5py
import numpy as np
import pytest
from theatres import player, put, small
from visitor import free_port, wait_for

from ar.overlay.outlines import compute_silhouette
from scenes.cli import main
from scenes.episodes.episode import collect
from scenes.page.demo import Demo
from scenes.play.frame_text import format_active_loads
from scenes.script.debulking import Debulking
from scenes.script.head_pose import build_drainage
from scenes.script.tool_paths import Touch
from sim.anatomy import TUMOUR_LABEL
from sim.deformation import build_start
from sim.effects import Resection
from sim.loads import Posture, Resected

SURGERY = Debulking(times=(0.05, 0.1, 0.15))


@pytest.fixture(scope="module")
def scene():
    """Seven small frames: corridor, a share, another share; the fluid is gone before."""
    return small("resection", duration=0.2, surgery=SURGERY, lying=build_drainage(0.04))


@pytest.fixture(scope="module")
def play(theatre, scene):
    return player(theatre, scene, "fem")


@pytest.fixture(scope="module")
def frames(play):
    return list(play.play_frames())


def test_resection_removes_corridor_then_tumour_from_the_top(box, theatre):
    corridor, *shares = (np.array(step) for step in SURGERY.build_resection(box).steps)
    middle = box.mesh.nodes[box.mesh.tets].mean(axis=1)
    assert (np.linalg.norm(middle[corridor, :2], axis=1) < 6.1e-3).all() and middle[corridor, 2].max() > -4e-3
    assert (box.mesh.region[corridor] != TUMOUR_LABEL).all()
    tumour = np.flatnonzero(box.mesh.region == TUMOUR_LABEL)
    left = np.setdiff1d(tumour, np.concatenate(shares))
    assert [len(step) for step in (*shares, left)] == pytest.approx(3 * [len(tumour) / 3], abs=1.0)
    depth = [-middle[step] @ [0.0, 0.0, 1.0] for step in (*shares, left)]
    assert all(upper.max() <= lower.min() + 1e-4 for upper, lower in pairwise(depth))
    assert [SURGERY.count_done(time) for time in (0.0, 0.0499, 0.05, 0.12, 9.0)] == [0, 0, 1, 2, 3]


def test_resection_scene_has_resection_effect_and_cause(theatre, scene):
    assert [type(effect) for effect in scene.get_effects_on(theatre.anatomy)][-1] is Resection
    loads = scene.build_loads(theatre.site, Touch(), 0.12)
    assert [type(cause) for cause in loads.causes] == [Posture, Resected]
    assert loads.get(Resected).done.tolist() == [2] and "resection: 2 steps done" in format_active_loads(
        loads, build_start(np.zeros((1, 3, 3))), theatre.site.anatomy.mesh.nodes
    )
    assert theatre.list_deformers(scene) == ("fem",)


def test_remaining_tumour_is_drawn_after_each_step(play, frames):
    areas = []
    for frame in frames:
        stage = play.stage.select_stage(frame.loads)
        layer = stage.build_tumour(play.compute_positions(frame.deformation))
        areas.append(int(compute_silhouette(frame.camera, layer.vertices, layer.triangles).sum()))
        assert not stage.anatomy.orphaned[stage.tumour_vertices].any()
        assert frame.deformation.outcome[0].good and frame.moved >= 0.0
    done = [SURGERY.count_done(frame.time) for frame in frames]
    assert done == sorted(done) and set(done) == {0, 1, 2, 3}
    seen = [areas[done.index(step)] for step in range(4)]
    assert seen[0] == pytest.approx(seen[1], rel=0.05) and seen[3] < 0.97 * seen[1]


def test_corridor_is_visible_in_the_cortex(play, frames):
    """Depth in the image increases in the hole."""
    before, after = frames[1].picture.depth, frames[2].picture.depth
    assert (after - before).max() > 4e-3 and (np.abs(after - before) < 1e-3).mean() > 0.9


def test_removed_tissue_has_no_displacement(play, frames):
    gone = play.stage.select_stage(frames[-1].loads).anatomy.orphaned
    moved = np.linalg.norm(frames[-1].deformation.displacement[0], axis=1)
    assert gone.any() and not moved[gone].any() and moved[~gone].max() > 1e-5


def test_episode_stores_the_remaining_tumour(theatre, play, scene, tmp_path):
    collect(tmp_path / "a.h5", theatre, play, "fem", iter)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["done"][:].tolist() == [SURGERY.count_done(time) for time in scene.times]
        left = file["tumour_left"][:]
        assert left.dtype == bool and left[0].all() and not left[-1].all()
        taken = file["tumour_predicted"][-1][~left[-1]] - file["tumour_rest"][:][~left[-1]]
        assert not taken.any() and "Resection(steps=" in file.attrs["effects"]


def test_page_shows_the_remaining_tumour(theatre, scene):
    demo = Demo(theatre, replace(scene, frames_per_second=30.0), "fem", "127.0.0.1", free_port())
    try:
        demo.wish.set(plays=False, number=0)
        whole = len(demo.browser.meshes["tumour"].faces)
        demo.wish.set(number=6)
        assert wait_for(lambda: demo.run(0.3) and "resection: 3 steps done" in demo.browser.shown[2])
        assert wait_for(lambda: len(demo.browser.meshes["tumour"].faces) < whole)
        rest = demo.stage.select_stage(scene.build_loads(theatre.site, Touch(), 0.2)).build_tumour(
            theatre.anatomy.mesh.nodes
        )
        assert np.array_equal(demo.browser.meshes["tumour"].faces, rest.triangles)
        assert wait_for(
            lambda: demo.run(0.2) and np.array_equal(demo.browser.meshes["finite elements"].faces, rest.triangles)
        )
    finally:
        demo.close()


def test_resection_scene_passes_the_check_command(theatre, tmp_path):
    words = ["check", "resection", "--anatomy", str(put(theatre, tmp_path / "box.vtu")), "--every", "75"]
    assert main([*words, "--device", "cpu"]) == 0
