"""Appearance from the scan: colours independent of the scanner's scale, and a deterministic vignette."""

from dataclasses import replace
from typing import cast

import numpy as np
from theatres import small, template_theatre

from scenes.play.player import Player
from scenes.play.stage import CORTEX, Stage
from scenes.script.viewpoint import PLAIN_APPEARANCE
from sim.bodies.intensity import Intensity
from sim.deformation import Deformer, build_start


def seen(values, scene=None):
    """The picture and its segmentation of the template with other grey values."""
    theatre, scene = template_theatre(), replace(scene or small(), look=PLAIN_APPEARANCE)
    stage = Stage(scene, theatre.site, Intensity(values, theatre.intensity.affine))
    picture = stage.render(scene.viewpoint.build_camera(theatre.site), theatre.anatomy.mesh.nodes, None)
    return picture


def test_cortex_colours_are_independent_of_scan_scale():
    grey = template_theatre().intensity.values.astype(np.float64)
    brain = grey[grey > 0.0]
    usual = seen(grey)
    cortex = usual.segmentation == CORTEX
    vessels = np.random.default_rng(0).random(grey.shape) < 0.02
    others = {
        "z-scores": (grey - brain.mean()) / brain.std(),
        "a negative offset": grey - 1000.0,
        "16 bits": np.rint(12.0 * grey - 3000.0).astype(np.int16),
        "fat round the brain": np.where(grey > 0.0, grey, 900.0),
    }
    for name, values in others.items():
        apart = np.abs(seen(values).colour.astype(int) - usual.colour)[cortex]
        assert (apart.max(axis=1) > 6).mean() < 2e-3, name  # but at the border, where fluid is
    # Vessels with contrast agent are where they are, and change nothing elsewhere.
    for value in (3.0 * grey.max(), np.nan):
        apart = np.abs(seen(np.where(vessels, value, grey)).colour.astype(int) - usual.colour)[cortex]
        assert np.percentile(apart, 90) <= 4 and apart.mean() < 2.0
    # Folds are darker than crowns, which are not saturated.
    red, green, _ = (usual.colour[cortex][:, k].astype(float) for k in range(3))
    assert np.percentile(green, 10) < 0.75 * np.percentile(green, 75)
    assert np.median(green / red) > 0.6


def test_constant_scan_gives_uniform_cortex_colour():
    plain = seen(np.full(template_theatre().intensity.values.shape, 3, np.uint8))
    colours = plain.colour[plain.segmentation == CORTEX].astype(float)
    shares = colours[:, 1] / colours[:, 0]
    assert shares.std() < 0.03


def test_microscope_vignette_is_deterministic():
    theatre, scene = template_theatre(), small()
    rest = build_start(np.zeros((1, *theatre.anatomy.mesh.nodes.shape)))
    views = [replace(scene.viewpoint, field=field) for field in (None, 1.0, 1.0)]
    stages = [Stage(replace(scene, viewpoint=view), theatre.site, theatre.intensity) for view in views]
    # No deformer is asked.
    players = [Player(stage, cast(Deformer, None)) for stage in stages]
    frames = [each.draw_frame(10, each.get_touch(10), each.build_loads(10), rest, 0.0) for each in players]
    assert frames[0].picture.colour[0, 0].any() and not frames[1].picture.colour[0, 0].any()
    assert frames[1].picture.colour.tobytes() == frames[2].picture.colour.tobytes()
    assert frames[1].shown.tobytes() == frames[2].shown.tobytes()
