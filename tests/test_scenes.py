"""The place that scripted tools work at, and what the camera sees of it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from theatres import PUSHING, on_template, small, template_theatre

from ar.optics.camera import project_cv2
from scenes.play.drape import clip_surface
from scenes.play.stage import CORTEX, DRAPE, TOOL, Stage
from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.head_pose import HeadPose
from scenes.script.scene import SCENES, find_scene
from scenes.script.tool import Probe
from scenes.script.tool_paths import IDLE_HEIGHT, Touch, compute_tool_height
from scenes.script.viewpoint import OBLIQUE_VIEWPOINT, TARGET_DEPTH, Viewpoint
from sim.compile import check_causes
from sim.errors import InputError
from surrogate.data.cortex_patch import open_patch


@pytest.fixture(scope="module")
def template():
    return template_theatre()


@pytest.fixture(scope="module", params=["box", "template"])
def site(request, box, template):
    return build_craniotomy_frame(box) if request.param == "box" else template.site


def sampled(path, times):
    """(n, 5): x, y, force, tilt."""
    return np.array([[touch.x, touch.y, touch.force, *touch.tilt] for touch in map(path, times)])


@pytest.mark.parametrize("name", SCENES)
def test_built_in_scenes_say_what_they_are_and_begin_as_the_scan(name, template):
    scene = find_scene(name)
    assert scene.name == name and len(scene.title.split()) > 5
    times = scene.times
    assert times[0] == 0.0 and times[-1] == pytest.approx(scene.duration) and np.allclose(np.diff(times), 1 / 30)
    assert scene.path(0.0).force == 0.0 and scene.lying(0.0) == HeadPose()
    loads = scene.build_loads(template.site, scene.path(0.0), 0.0)
    check_causes(scene.get_effects_on(template.anatomy), loads)


@pytest.mark.parametrize("name", PUSHING)
def test_built_in_scenes_end_idle(name):
    scene = find_scene(name)
    force = sampled(scene.path, scene.times)[:, 2]
    assert force[0] == 0.0 and force[-1] == pytest.approx(0.0, abs=1e-12) and 0.1 < force.max() < 0.4


class TestSite:
    def test_frame_stands_on_the_surface_and_points_inwards(self, site):
        axes = np.stack([site.right, site.up, -site.axis])
        assert np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) == pytest.approx(1.0)
        nodes = site.anatomy.mesh.nodes
        assert (nodes.mean(axis=0) - site.origin) @ site.axis > 0.015
        assert np.allclose(site.find_contact(0.0, 0.0, 0.0).point, site.origin, atol=1e-9)

    def test_the_circle_of_its_clearance_is_open_and_no_larger_one(self, site):
        angle = np.linspace(0.0, 2.0 * np.pi, 721)
        ring = np.cos(angle)[:, None] * site.right + np.sin(angle)[:, None] * site.up
        nodes = site.anatomy.mesh.nodes
        flat = nodes - np.outer((nodes - site.origin) @ site.axis, site.axis)
        shadow = trimesh.Trimesh(flat, site.anatomy.open_surface, process=False)
        for share, covered in ((0.99, True), (1.01, False)):
            gap = trimesh.proximity.closest_point_naive(shadow, site.origin + share * site.clearance * ring)[1]
            assert (gap.max() < 5e-5) == covered  # trimesh is exact to some 10 um on edges
        assert 0.6 * site.radius < site.clearance <= 1.05 * site.radius

    def test_a_contact_is_a_material_point(self, site):
        nodes = site.anatomy.mesh.nodes
        contact = site.find_contact(0.006, -0.004, 0.007)
        assert contact.weights.sum() == pytest.approx(1.0) and contact.weights.min() >= 0.0
        assert np.allclose(contact.locate(nodes), contact.point)
        turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
        assert np.allclose(contact.locate(nodes @ turn.T + [0.1, 0.0, 0.2]), turn @ contact.point + [0.1, 0.0, 0.2])
        place = contact.point - site.origin
        assert place @ site.right == pytest.approx(0.006, rel=0.15)
        assert place @ site.up == pytest.approx(-0.004, rel=0.15)

    def test_the_tool_stays_inside_the_opening(self, site):
        for x, y in ((0.1, 0.0), (-0.03, 0.03), (0.0, -0.02)):
            point = site.find_contact(x, y, 0.007).point[None]
            assert open_patch(site.anatomy).compute_edge_distance(point)[0] > 0.007 * 0.999
            assert site.compute_axis_distance(point)[0] > 0.95 * site.compute_reach(0.007)
        assert np.allclose(site.find_contact(0.1, 0.1, 1.0).point, site.origin, atol=1e-9)

    def test_direction_tilts_as_asked(self, site):
        assert np.allclose(site.compute_direction(Touch()), site.axis)
        for tilt, aside in (((0.5, 0.0), site.right), ((0.0, 0.5), site.up)):
            way = site.compute_direction(Touch(tilt=tilt))
            assert np.linalg.norm(way) == pytest.approx(1.0)
            assert np.arctan2(way @ aside, way @ site.axis) == pytest.approx(0.5)

    def test_a_body_without_opening_is_refused(self, box):
        with pytest.raises(InputError, match="no open cortex"):
            build_craniotomy_frame(replace(box, craniotomy=np.zeros(len(box.mesh.nodes), bool)))


class TestTool:
    def test_the_ball_touches_the_tip_from_outside(self):
        probe, tip = Probe(), np.array([0.01, 0.02, 0.03])
        inward, aside = np.array([0.0, 0.6, -0.8]), np.array([1.0, 0.0, 0.0])
        for lean in (0.0, 0.4, 0.75):
            T = replace(probe, lean=lean).pose(tip, inward, aside)
            assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
            at = np.asarray(probe.mesh.vertices) @ T[:3, :3].T + T[:3, 3]
            assert ((at - tip) @ inward).max() == pytest.approx(0.0, abs=1e-4)
            far = at[np.argmax(np.linalg.norm(at - tip, axis=1))] - tip
            assert np.arctan2(far @ aside, -far @ inward) == pytest.approx(lean, abs=0.06)

    def test_the_ball_has_the_radius_of_the_footprint(self, template):
        scene = find_scene("press")
        loads = scene.build_loads(template.site, Touch(force=0.2), 1.5)
        (pushed,) = loads.causes
        mesh = scene.tool.mesh
        ball = np.linalg.norm(mesh.vertices - [0.0, 0.0, scene.tool.radius], axis=1)[:642]
        assert np.allclose(ball, pushed.footprint[0]) and mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-12)
        assert np.allclose(pushed.force[0], 0.2 * template.site.axis) and loads.times[0] == 1.5


class TestCamera:
    def test_looks_at_the_open_cortex_from_outside(self, site):
        camera = OBLIQUE_VIEWPOINT.build_camera(site)
        assert (camera.centre - site.origin) @ site.axis < -0.1
        middle = project_cv2(camera, (site.origin + TARGET_DEPTH * site.axis)[None])[0]
        assert np.allclose(middle, [319.5, 239.5], atol=1e-6)
        a, b, c = (site.anatomy.mesh.nodes[site.anatomy.open_surface[:, k]] for k in range(3))
        facing = np.einsum("si,si->s", np.cross(b - a, c - a), camera.centre - a) > 0.0
        assert facing.mean() > 0.97
        above, aside = (
            project_cv2(camera, (site.origin + TARGET_DEPTH * site.axis + 0.01 * way)[None])[0]
            for way in (site.up, site.right)
        )
        assert above[1] < middle[1] - 10.0 and aside[0] > middle[0] + 10.0

    @pytest.mark.parametrize("tilt", [-0.35, 0.0, 0.5])
    def test_it_stands_as_far_and_as_high_as_asked(self, site, tilt):
        camera = Viewpoint(distance=0.15, tilt=tilt, fov=0.4, width=200, height=100).build_camera(site)
        away = camera.centre - site.origin - TARGET_DEPTH * site.axis
        along = [away @ way for way in (-site.axis, site.up, site.right)]
        assert along == pytest.approx([0.15 * np.cos(tilt), 0.15 * np.sin(tilt), 0.0], abs=1e-12)
        assert (camera.vertical_fov, camera.width, camera.height) == (pytest.approx(0.4), 200, 100)

    @pytest.mark.parametrize("name", PUSHING)
    def test_cortex_drape_and_tool_are_seen(self, template, name):
        play = on_template(name)
        frame = play.draw(40, 1.3, play.scene.path(1.3))
        share = np.bincount(frame.picture.segmentation.ravel(), minlength=5) / frame.picture.segmentation.size
        assert share[CORTEX] > 0.08 and share[TOOL] > 0.03 and share[DRAPE] > 0.2 and share[4] == 0.0
        # Pixels of the cortex lie on the deformed surface or in its sulci, under the edge of the bone too.
        pixels = np.argwhere(frame.picture.segmentation == CORTEX)[::97]
        depth = frame.picture.depth[tuple(pixels.T)]
        seen = frame.camera.unproject(pixels[:, ::-1].astype(float), depth)
        surface = trimesh.Trimesh(
            play.compute_positions(frame.deformation), template.anatomy.mesh.surface, process=False, validate=False
        )
        away = trimesh.proximity.closest_point_naive(surface, seen)[1]
        assert away.max() < 5e-3 and np.percentile(away, 75) < 2e-3


def test_the_cortex_wears_the_scan(template):
    scene = small()
    assert template.intensity is not None
    plain, dressed = (Stage(scene, template.site, scan).without_fine_cortex for scan in (None, template.intensity))
    rest = template.anatomy.mesh.nodes
    assert plain.build_visible_cortex(rest).solid is None
    layer = dressed.build_visible_cortex(rest + 0.001)
    assert layer.solid is not None and layer.rest is not None
    # Read at the material points, 2 mm under the surface, wherever they are now.
    assert np.allclose(layer.rest, dressed.build_visible_cortex(rest).rest)
    depth = np.linalg.norm(layer.rest - dressed.build_visible_cortex(rest).vertices, axis=1)
    assert np.allclose(depth, 2e-3)


def test_clipping_keeps_the_positive_part():
    random = np.random.default_rng(3)
    points = np.column_stack([random.random((60, 2)), np.zeros(60)])
    triangles = random.permuted(np.tile(np.arange(60), (80, 1)), axis=1)[:, :3]
    value = points @ [1.0, -0.7, 0.0] - 0.1

    def area(points, triangles):
        a, b, c = (points[triangles[:, k]] for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()

    above, over, rim = clip_surface(points, triangles, value)
    below, under, _ = clip_surface(points, triangles, -value)
    assert area(above, over) + area(below, under) == pytest.approx(area(points, triangles))
    assert min(area(above, over), area(below, under)) > 0.1 * area(points, triangles)
    assert (above[over] @ [1.0, -0.7, 0.0] - 0.1).min() > -1e-12
    assert np.allclose(above[rim] @ [1.0, -0.7, 0.0], 0.1)


def test_an_unknown_scene_is_named_with_the_known_ones():
    with pytest.raises(InputError, match=r"'dance'.*press, slide, draw"):
        find_scene("dance")


def test_no_force_is_seen_to_act_through_the_air():
    assert compute_tool_height(0.0) == IDLE_HEIGHT and compute_tool_height(0.005) == compute_tool_height(0.3) == 0.0
