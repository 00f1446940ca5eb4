"""Images of a scene in each style: drape and bone, legible text, and colours for colour-blind eyes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ar.overlay.composite import DOUBTFUL_COLOUR, composite
from ar.overlay.gauge import NUMBER_SCALE, DistanceGauge
from ar.overlay.legend import SHEET_VALUE
from ar.overlay.marks import BEFORE_COLOUR, Marks, Occluders
from ar.overlay.outlines import average_colour, find_text
from ar.overlay.styles import STYLES
from scenes.cli import main
from scenes.play.checks import measure_frames
from scenes.play.deformers import open_theatre
from scenes.play.drape import DRAPE_COLOUR
from scenes.play.frame_text import annotate_image
from scenes.play.observer import ELLIPSOID_COLOUR
from scenes.play.player import measure_tip_gauge
from scenes.play.scene_costs import draw_cost_panel
from scenes.play.stage import CORTEX_COLOUR, DRAPE, OPENING, TOOL, TRUTH_COLOUR, TUMOUR_COLOUR
from scenes.script.scene import Bounds, find_scene
from scenes.script.viewpoint import OBLIQUE_VIEWPOINT
from sim.geometry.surface import is_enclosing

LINES = {
    "tumour": TUMOUR_COLOUR,
    "doubt": DOUBTFUL_COLOUR,
    "scan": BEFORE_COLOUR,
    "truth": TRUTH_COLOUR,
    "middle": ELLIPSOID_COLOUR,
}
GROUNDS = {"cortex": CORTEX_COLOUR, "drape": DRAPE_COLOUR}
# Machado, Oliveira & Fernandes 2009, severity 1: of linear RGB.
EYES = {
    "all cones": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
# Differences of this size are seen at a glance (CIE 1976).
PLAIN = 25.0


def lab(colour, eye):
    """CIELAB of sRGB in [0, 1], as an eye sees it."""
    share = np.asarray(colour, np.float64)
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    seen = np.clip(EYES[eye] @ linear, 0.0, 1.0)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ seen
    x, y, z = np.cbrt(xyz / [0.9505, 1.0, 1.089])
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize("eye", EYES)
def test_line_colours_are_distinct_for_colour_blind_eyes(eye):
    for name, colour in LINES.items():
        for other, ground in (LINES | GROUNDS).items():
            if name != other:
                assert np.linalg.norm(lab(colour, eye) - lab(ground, eye)) > PLAIN, (name, other)
    red, green = (0.8, 0.3, 0.2), (0.45, 0.5, 0.15)
    far = np.linalg.norm(lab(red, eye) - lab(green, eye))
    assert far > PLAIN if eye == "all cones" else far < 45.0  # the eyes are what they are called


@cache
def player(size, style="window"):
    theatre = open_theatre(device="cpu")
    scene = find_scene("press")
    scene = replace(scene, viewpoint=replace(OBLIQUE_VIEWPOINT, width=size[0], height=size[1]))
    return replace(theatre.build_player("series-gp", scene), style=style)


@cache
def build_tool_frame(size=(640, 360), style="window"):
    play = player(size, style)
    return play.draw(40, float(play.scene.times[40]), play.get_touch(40))


def broken(frame, play):
    """What is wrong with a frame, if the model's own answer is the truth."""
    found = measure_frames(play, play.get_camera, [frame], frame.deformation)
    return [sentence for sentence in found.find_violations(Bounds(visible=0.3)) if "does not say its" not in sentence]


@pytest.mark.parametrize("style", [style for style in STYLES if style != "none"])
def test_every_style_passes_the_checks(style):
    frame, play = build_tool_frame(style=style), player((640, 360), style)
    assert measure_frames(play, play.get_camera, [frame], frame.deformation).find_violations(Bounds(visible=0.3)) == []
    tool = frame.picture.segmentation == TOOL
    words = (np.abs(frame.shown.astype(int) - frame.picture.colour).max(axis=2) > 2) & tool
    assert words.sum() < 0.1 * tool.sum()  # the lines at the head may stand there


def again(frame, play, opening, gauge=None, style="window"):
    """The frame's picture, drawn again from the same answer."""
    stage = play.stage
    tumour, rest = (
        stage.build_tumour(at) for at in (play.compute_positions(frame.deformation), play.site.anatomy.mesh.nodes)
    )
    if gauge is None:
        gauge = replace(measure_tip_gauge(frame.tip, tumour), reading=frame.distance, error=frame.tumour_error.bound)
    band = frame.tumour_error.bound or 0.0
    over = composite(
        frame.picture,
        play.camera,
        tumour,
        style=style,
        cover=Occluders((TOOL,), opening=opening),
        marks=Marks(band, gauge=gauge, initial=rest),
    )
    annotate_image(over, frame.number, frame.remark)
    return replace(frame, shown=over.colour)


def test_overlay_below_the_drape_must_be_drawn_as_covered():
    frame, play = build_tool_frame(), player((640, 360))
    seen = "as if it were visible"
    assert broken(again(frame, play, OPENING), play) == []
    for opening in (None, replace(OPENING, ids=(*OPENING.ids, DRAPE))):  # all solid and shaded
        assert any(seen in sentence for sentence in broken(again(frame, play, opening), play))
    speechless = replace(OPENING, labels=((DRAPE, "over there"),))
    assert any(seen in sentence for sentence in broken(again(frame, play, speechless), play))
    shaded = again(frame, play, OPENING)
    closed = frame.picture.segmentation == DRAPE
    shaded.shown[closed & (shaded.shown == frame.picture.colour).all(axis=2)] //= 2
    assert any(seen in sentence for sentence in broken(shaded, play))


def test_tip_distance_text_must_be_complete_and_near_the_tip():
    frame, play = build_tool_frame(), player((640, 360))
    text = str(DistanceGauge(frame.tip, frame.tip, frame.distance, frame.tumour_error.bound))
    left, top, right, foot = find_text(frame.shown, text, NUMBER_SCALE)
    box, wide = np.s_[top - 3 : foot + 3, left - 3 : right + 3], right - left
    for to in (np.s_[-60 - (foot - top) - 6 : -60, 4 : wide + 10], None):
        shown = frame.shown.copy()
        shown[box] = frame.picture.colour[box]
        if to is not None:
            shown[to] = frame.shown[box]
        else:
            shown[box][:, : wide // 2] = frame.shown[box][:, : wide // 2]  # cut off
        assert any("cut off, or far" in sentence for sentence in broken(replace(frame, shown=shown), play))


def test_cost_label_does_not_cover_the_tool_in_a_low_image():
    frame = build_tool_frame()
    changed = (draw_cost_panel(frame, "series-gp") != frame.shown).any(axis=2)
    assert changed.sum() > 5000 and not changed[frame.picture.segmentation == TOOL].any()


def test_cost_label_does_not_cover_the_legend():
    for size in ((640, 360), (640, 480)):
        frame = build_tool_frame(size, "depth")
        changed = (draw_cost_panel(frame, "series-gp") != frame.shown).any(axis=2)
        assert (frame.taken == SHEET_VALUE).any() and changed.any() and not changed[frame.taken == SHEET_VALUE].any()


def test_gauge_reports_tip_inside_the_tumour():
    play = player((640, 360))
    rest = play.stage.tumour_at_rest
    middle, corners = rest.vertices.mean(axis=0), rest.vertices[rest.triangles]
    assert (
        measure_tip_gauge(middle, rest).is_inside and not measure_tip_gauge(middle + [0.03, 0.0, 0.0], rest).is_inside
    )
    assert is_enclosing(corners[:, ::-1], middle) and not is_enclosing(corners, middle + [0.0, 0.0, 0.5])
    assert str(measure_tip_gauge(middle, rest)).startswith("inside, ")


def test_frame_drawn_twice_gives_identical_image():
    play = player((640, 360), "rings")
    frame = build_tool_frame(style="rings")
    anew = play.draw(40, float(play.scene.times[40]), play.get_touch(40))
    assert np.array_equal(anew.shown, frame.shown)
    assert np.abs(frame.shown.astype(int) - build_tool_frame().shown).max() > 50


def test_frame_without_overlay_keeps_scene_image_and_values():
    frame, play = build_tool_frame(), player((640, 360))
    bare = replace(play, composed=False).draw(frame.number, frame.time, frame.touch)
    np.testing.assert_array_equal(bare.shown, bare.picture.colour)
    np.testing.assert_array_equal(bare.picture.colour, frame.picture.colour)
    assert not np.array_equal(frame.shown, frame.picture.colour) and not bare.taken.any()
    assert (bare.distance, bare.moved, bare.tumour_error) == (frame.distance, frame.moved, frame.tumour_error)


def test_command_help_lists_all_overlay_styles(capsys):
    for command in ("render", "demo", "check", "collect"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        said = capsys.readouterr().out
        assert all(
            f"{style}: {words[:12]}" in " ".join(said.split()) for style, words in STYLES.items() if style != "none"
        )
    with pytest.raises(SystemExit):
        main(["check", "press", "--style", "none"])
    assert "invalid choice" in capsys.readouterr().err
    assert average_colour(TUMOUR_COLOUR) == (51.0, 240.0, 107.0)
