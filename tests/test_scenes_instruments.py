"""Natural appearance: instruments with the contact shape at their tips, folded drape and camera effects."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from theatres import small, template_theatre

from ar.rendering.camera_effects import add_camera_effects, blur_by_depth
from scenes.play.instruments import build_instrument, has_instrument
from scenes.play.stage import DRAPE, TOOL, Stage
from scenes.script.tool import Blade, Probe
from scenes.script.viewpoint import Appearance, BallInstrument
from sim.errors import InputError
from sim.tools import get_core


@pytest.fixture(scope="module")
def stage():
    theatre = template_theatre()
    return Stage(small(), theatre.site, theatre.intensity)


@pytest.mark.parametrize("kind", get_args(BallInstrument))
@pytest.mark.parametrize("radius", [3e-3, 7e-3, 10e-3])
def test_lower_end_of_an_instrument_is_its_contact_ball(kind, radius):
    vertices = np.concatenate([part.vertices for part in build_instrument(Probe(radius), kind, TOOL)])
    low = vertices[vertices[:, 2] < radius]
    away = np.linalg.norm(low - (0.0, 0.0, radius), axis=1)
    ball = away[away > 0.7 * radius]  # others are inside
    assert len(ball) > 1000 and away.max() < radius + 1e-9 and ball.min() > radius - 0.21e-3
    assert vertices[:, 2].max() > 0.1


@pytest.mark.parametrize("blade", [Blade(), Blade(16e-3, 28e-3, 2e-3)])
def test_spatula_surface_equals_blade_in_contact_region(blade):
    vertices, core = build_instrument(blade, "dissector", TOOL)[0].vertices, get_core(blade.shape)
    beyond = np.maximum(np.abs(vertices - core.centre) - core.half, 0.0)
    away = np.linalg.norm(beyond, axis=1) - core.radius
    on_blade = vertices[:, 1] < 0.5 * blade.length - 4e-3
    below = on_blade & (vertices[:, 2] < blade.edge - 1e-9) & (beyond.max(axis=1) > 0.0)
    outer = below & (away > -0.05e-3)
    assert away[on_blade].max() < 1e-6 and outer.sum() > 150
    assert np.ptp(vertices[on_blade], axis=0)[0] == pytest.approx(blade.width) and vertices[:, 2].min() < 1e-6
    assert away[vertices[:, 2] < blade.edge].max() < 1e-6  # the bend stays inside as well


def test_tools_without_instrument_use_their_own_mesh(stage):
    class Mine(Probe):
        """A shape of its own."""

    assert has_instrument(Probe(3e-3)) and has_instrument(Blade())
    for tool in (Mine(7e-3), Probe(2e-3), Blade(8e-3, 8e-3, 3.5e-3), Blade(4e-3, 20e-3, 2e-3), None):
        assert not has_instrument(tool)
    own = replace(stage, scene=replace(stage.scene, tool=Mine(7e-3)))
    layer = own.build_layers(stage.anatomy.mesh.nodes, np.eye(4))[-1]
    assert np.array_equal(layer.vertices, Mine(7e-3).mesh.vertices)


def test_plain_look_has_the_simple_tool_and_drape(stage):
    rest, tool = stage.anatomy.mesh.nodes, stage.scene.tool
    simple, natural = (each.build_layers(rest, np.eye(4)) for each in (stage.without_fine_cortex, stage))
    assert np.array_equal(simple[-1].vertices, tool.mesh.vertices) and len(simple) == 3
    assert {layer.id for layer in natural[2:]} == {TOOL} and len(natural[-1].vertices) > len(simple[-1].vertices)
    assert len(natural[1].triangles) > 5 * len(simple[1].triangles)


def test_folds_of_the_drape_leave_its_hole_open(stage):
    rest, camera = stage.anatomy.mesh.nodes, stage.camera
    folded, plain = (each.render(camera, rest, None).segmentation for each in (stage, stage.without_fine_cortex))
    changed = (folded == DRAPE) & (plain != DRAPE) & (plain != 0)
    assert changed.sum() < 0.01 * (plain == DRAPE).sum()
    assert np.ptp(stage.build_layers(rest, None)[1].colour[:, 1]) > 0.05


def test_camera_effects_are_repeatable_and_keep_depth(stage):
    rest, camera, focus = stage.anatomy.mesh.nodes, stage.camera, stage.site.origin
    sharp = stage.render(camera, rest, None)
    assert add_camera_effects(sharp, camera, focus, 0.0, 0.0, 3) is sharp
    first, again, other = (add_camera_effects(sharp, camera, focus, 0.0, 0.02, k).colour for k in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    grey = (sharp.colour > 40) & (sharp.colour < 215)
    assert (first.astype(float) - sharp.colour)[grey].std() == pytest.approx(0.02 * 255.0, rel=0.05)
    stripes = np.tile(np.uint8([0, 0, 200, 200]), (64, 16))[..., None].repeat(3, axis=2)
    depth = np.where(np.arange(64) < 32, 0.3, 0.2).astype(np.float32)[:, None].repeat(64, axis=1)
    blurred = blur_by_depth(stripes, depth, 10.0, 0.3)
    assert np.array_equal(blurred[:20], stripes[:20]) and blurred[44:].std() < 0.2 * stripes.std()
    wide = replace(stage.scene, look=replace(stage.scene.look, aperture=0.02, noise=0.01))
    shown = replace(stage, scene=wide).render_view(camera, rest, None, False, 1)
    assert not np.array_equal(shown.colour, sharp.colour) and np.array_equal(shown.depth, sharp.depth)
    for wrong in ({"aperture": -1.0}, {"aperture": "0.02"}, {"noise": np.nan}, {"instrument": "hammer"}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            Appearance(**wrong)
