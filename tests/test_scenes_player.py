"""Player of scenes: tool at rest on the tissue, and frames that depend on their moment alone."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from theatres import PUSHING, on_template, player, short, small

from ar.optics.camera import project_cv2
from ar.overlay.composite import WARNING_COLOUR
from ar.overlay.hud import MAX_BOTTOM_WIDTH, TEXT_SCALE, WHITE, wrap_line
from ar.overlay.outlines import average_colour, has_text
from scenes.play.frame_text import shorten_source
from scenes.play.player import BONE_WARNING, CARRIED_DEPTH, STAGES
from scenes.play.stage import CORTEX, TOOL
from scenes.script.scene import Viewpoint
from scenes.script.tool_paths import Touch
from sim.effects import Elasticity
from sim.fem import describe_solver
from sim.material import Material, Ogden
from surrogate.model.learned import Learned


def heights(play, frame, points):
    """Signed distance (n,) [m] of points from the deformed open cortex, positive outside."""
    surface = trimesh.Trimesh(play.compute_positions(frame.deformation), play.site.anatomy.open_surface, process=False)
    nearest, distance, triangle = trimesh.proximity.closest_point_naive(surface, points)
    side = np.einsum("ni,ni->n", points - nearest, surface.face_normals[triangle])
    return np.where(side >= 0.0, distance, -distance)


def says(picture, text, ink=WHITE):
    """Whether a picture (H, W, 3) says a sentence, folded as it has to be."""
    return all(
        has_text(picture, line, TEXT_SCALE, ink) for line in wrap_line(text, MAX_BOTTOM_WIDTH * picture.shape[1])
    )


def test_pressing_tip_rests_on_the_deformed_surface(play):
    """The ball touches the tissue, and no point of the tissue is inside it."""
    touch, radius = play.scene.path(1.7), play.scene.tool.radius
    frame = play.draw(51, 1.7, touch)
    rest = play.scene.find_contact(play.site, touch).point
    assert (frame.tip - rest) @ play.site.axis > 1e-3  # it has gone in with the tissue
    middle = frame.pose[:3, :3] @ [0.0, 0.0, radius] + frame.pose[:3, 3]
    assert np.linalg.norm(middle - frame.tip) == pytest.approx(radius)
    assert heights(play, frame, middle[None])[0] == pytest.approx(radius, abs=1e-8)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_tool_below_the_bone_stops_at_its_edge_with_remark(play, way):
    play = replace(play, style="none")  # a model of so few loads draws its bound all over the picture
    radius = play.scene.tool.radius
    frame = play.draw(0, 0.0, Touch(way * 0.1, way * 0.1, force=0.1))
    assert frame.remark.startswith("the bone's edge stops the tool ") and frame.remark.endswith(" mm short")
    assert says(frame.shown, frame.remark)
    assert play.site.compute_axis_distance(frame.tip[None])[0] <= play.site.compute_reach(radius) + CARRIED_DEPTH
    inside = play.draw(0, 0.0, Touch(force=0.1))
    assert inside.remark == "" and not says(inside.shown, frame.remark)


def test_result_is_unreliable_with_tissue_pressed_into_bone(theatre):
    """Largest force of the training range at the rim: the ball stays inside, and the image shows the warning."""
    play = player(theatre, replace(small(), viewpoint=Viewpoint()), "fem")
    reach = play.site.compute_reach(play.scene.tool.radius)
    frame = play.draw(0, 0.0, Touch(reach, 0.0, force=0.4, tilt=(np.radians(40.0), 0.0)))
    assert frame.doubt == BONE_WARNING and all(
        says(frame.shown, part, average_colour(WARNING_COLOUR)) for part in BONE_WARNING.split(": ")
    )
    assert play.site.compute_axis_distance(frame.tip[None])[0] <= reach + 1e-9 and frame.distance_error is None


def test_smaller_force_gives_smaller_tip_depth(play):
    depth = [(play.draw(0, 0.0, Touch(force=force)).tip - play.site.origin) @ play.site.axis for force in (0, 0.1, 0.2)]
    assert depth[0] == pytest.approx(-4e-3) and 0.0 < depth[1] < depth[2]


@pytest.mark.parametrize("name", PUSHING)
def test_idle_tool_is_outside_the_tissue(template, name):
    play = on_template(name)
    tool = np.asarray(play.scene.tool.mesh.vertices)
    for number in (0, len(play.scene.times) - 1):
        time = float(play.scene.times[number])
        frame = play.draw(number, time, play.scene.path(time))
        assert not frame.deformation.displacement.any()
        at = tool @ frame.pose[:3, :3].T + frame.pose[:3, 3]
        assert heights(play, frame, at[:642]).min() > 2e-3
        surface = template.anatomy.mesh.nodes[np.unique(template.anatomy.mesh.surface)]
        shaft = at[642:]
        assert ((shaft - play.site.origin) @ play.site.axis < 0.0).all()
        assert np.linalg.norm(shaft[:, None] - surface, axis=2).min() > 4e-3


def test_frame_does_not_depend_on_frames_drawn_before(play):
    """Another frame is drawn in between."""
    touch = play.scene.path(1.2)
    first = play.draw(36, 1.2, touch)
    play.draw(3, 0.1, Touch(0.01, 0.0, 0.1, (0.3, 0.1)))
    again = play.draw(36, 1.2, touch)
    for name in ("colour", "depth", "segmentation"):
        assert np.array_equal(getattr(first.picture, name), getattr(again.picture, name))
    assert np.array_equal(first.shown, again.shown) and np.array_equal(first.pose, again.pose)
    assert np.array_equal(first.deformation.displacement, again.deformation.displacement)
    assert first.distance == again.distance and first.touch == again.touch


def test_batched_frames_equal_single_frames(theatre):
    play = player(theatre, short(), "linear")
    alone, together = list(play.play_frames()), list(play.play_frames(together=4))
    assert [frame.number for frame in together] == [frame.number for frame in alone]
    for one, other in zip(alone, together, strict=True):
        assert one.touch == other.touch and one.time == other.time
        np.testing.assert_allclose(other.deformation.displacement, one.deformation.displacement, atol=5e-9)  # single
        np.testing.assert_allclose(other.distance, one.distance, atol=5e-9)
        assert np.mean(other.picture.segmentation == one.picture.segmentation) > 0.999


def test_frames_have_number_time_and_load_of_their_moment(theatre):
    for name in ("linear", "fem"):
        play = player(theatre, short(), name)
        frames = list(play.play_frames())
        assert [frame.number for frame in frames] == list(range(7)) == list(range(len(play.scene.times)))
        for frame, time in zip(frames, play.scene.times, strict=True):
            assert frame.time == time == frame.loads.times[0] == frame.deformation.time[0]
            assert frame.touch == play.scene.path(time) and frame.deformation.outcome[0].good
            assert tuple(frame.seconds) == STAGES and min(frame.seconds.values()) > 0.0
        assert [frame.number for frame in play.play_frames(every=3)] == [0, 3, 6]
        pictures = {frame.shown.tobytes() for frame in frames[:4]}
        assert len(pictures) == 4


def test_warm_starts_change_displacements_by_under_50_um(theatre):
    play = player(theatre, short(), "fem")
    cold = [
        play.draw(number, float(time), play.scene.path(float(time))) for number, time in enumerate(play.scene.times)
    ]
    for frame, alone in zip(play.play_frames(), cold, strict=True):
        difference = np.linalg.norm(frame.deformation.displacement - alone.deformation.displacement, axis=2)
        assert difference.max() < 5e-5


@pytest.mark.parametrize("name", PUSHING)
def test_overlay_draws_only_lines_over_the_tool(name):
    play = on_template(name)
    for number in (20, 50, 75):
        time = float(play.scene.times[number])
        frame = play.draw(number, time, play.scene.path(time))
        tool = frame.picture.segmentation == TOOL
        changed = (frame.shown != frame.picture.colour).any(axis=2)
        label = np.zeros_like(changed)  # the number beside the tumour may be written over a shaft
        rows = np.flatnonzero(changed.any(axis=1))
        label[rows.max() - 26 :] = True
        label[:, :125] = True  # where so small a picture has the errors
        assert tool.sum() > 500 and 0 < (tool & changed & ~label).sum() < 0.2 * tool.sum()
        assert (changed & (frame.picture.segmentation == CORTEX)).sum() > 500


def test_overlay_covers_the_opencv_projection_of_the_tumour(play):
    """Independent check: tumour vertices projected by OpenCV lie inside the changed pixels."""

    frame = play.draw(51, 1.7, play.scene.path(1.7))
    changed = (frame.shown != frame.picture.colour).any(axis=2)
    corners = play.compute_positions(frame.deformation)[play.site.anatomy.tumour_nodes]
    column, row = np.rint(project_cv2(play.camera, corners)).astype(int).T
    seen = frame.picture.segmentation[row, column] == CORTEX
    assert seen.sum() > 4 and changed[row, column][seen].mean() > 0.97


def test_frame_computes_resting_tip_and_nearest_point_once(play, monkeypatch):
    found = []
    for place, name in (
        ("scenes.play.player", "find_resting_tip"),
        ("sim.bodies.tip_distance", "find_resting_tips"),
        ("scenes.play.player", "find_closest_points"),
        ("sim.bodies.tip_distance", "find_closest_points"),
    ):
        whole = getattr(importlib.import_module(place), name)

        def counted(*given, name=name, whole=whole):
            found.append(name)
            return whole(*given)

        monkeypatch.setattr(f"{place}.{name}", counted)
    frame = play.draw(3, 0.1, Touch(force=0.3))
    assert sorted(found) == ["find_closest_points", "find_resting_tip"] and frame.distance is not None


def test_distance_equals_sampled_distance_from_tip_to_tumour(play):
    frame = play.draw(51, 1.7, play.scene.path(1.7))
    corners = play.compute_positions(frame.deformation)[play.site.anatomy.tumour_surface]
    share = np.random.default_rng(0).dirichlet(np.ones(3), 2000)
    samples = np.einsum("nc,scx->snx", share, corners).reshape(-1, 3)
    least = np.linalg.norm(samples - frame.tip, axis=1).min()
    bare = replace(play, deformer=replace(play.deformer, tip=None)) if isinstance(play.deformer, Learned) else play
    read = bare.draw(51, 1.7, play.scene.path(1.7)).distance
    assert read <= least < read + 2e-4
    if bare is not play:  # what it is off by on average is added
        assert frame.distance == pytest.approx(
            play.deformer.predict_distance(frame.loads, frame.deformation).distance[0], rel=1e-12
        )


def test_trained_model_and_fem_give_similar_displacements(theatre):
    """Same scene, same call: the difference is below a tenth of the motion."""
    nodes = theatre.anatomy.tumour_nodes
    fem, learnt = (
        player(theatre, small(), name).draw(51, 1.7, Touch(force=0.2)).deformation.restrict(nodes).displacement
        for name in ("fem", "linear")
    )
    assert np.linalg.norm(fem, axis=2).mean() > 3e-4
    assert np.linalg.norm(fem - learnt, axis=2).mean() < 0.1 * np.linalg.norm(fem, axis=2).mean()


def test_shortened_source_names_regions_with_own_tissue():
    own = Elasticity(regions={2: Material("neo-hookean", 9e3, 0.49), 3: Ogden(((1.0, 2.0), (3.0, 4.0)), 1e5)})
    whole = describe_solver("p1", [replace(own, regions=own.regions | {7: Material("linear", 1e3, 0.4)})])
    brief = describe_solver("p1", [Elasticity()]).removesuffix(")")
    assert shorten_source(f"linear, from {whole}") == f"linear, from {brief}; own tissue: tumour, oedema, region 7)"
    assert shorten_source(f"{brief})") == f"{brief})"
