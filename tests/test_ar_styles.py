"""Overlay styles: registration, occlusion by tools, and dashed lines outside the opening."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from ar.optics.camera import look_at
from ar.overlay.composite import composite, wrap_header
from ar.overlay.distances import RING_COLOUR, build_bvh, compute_signed_distance
from ar.overlay.gauge import NUMBER_SCALE, DistanceGauge
from ar.overlay.hud import FONT, LINE_SPACING, TEXT_SCALE, WHITE, draw_text_panel, wrap_line
from ar.overlay.legend import SHEET_VALUE
from ar.overlay.marks import ImageText, Marks, Occluders
from ar.overlay.outlines import (
    average_colour,
    compute_silhouette,
    find_colour,
    find_text,
    has_text,
    measure_outline_distance,
)
from ar.overlay.styles import STYLES, Opening
from ar.rendering.layer import Layer
from ar.rendering.renderer import Lamp, render

CORTEX, TOOL, TUMOUR, DRAPE = 1, 2, 3, 4
GREEN = (0.2, 0.94, 0.42)
OPENING = Opening((CORTEX,), ((DRAPE, "under the drape"),), "seen through bone")
DRAWN = [style for style in STYLES if style != "none"]
CAMERA = look_at(np.array([0.0, -0.05, 0.25]), np.zeros(3), np.array([0.0, 1.0, 0.0]), np.radians(25.0), 640, 480)


def ball(name, layer, centre, radius, colour=GREEN):
    made = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return Layer(name, layer, made.vertices + np.array(centre), made.faces, colour)


def sheet(name, layer, left, right, colour=(0.86, 0.60, 0.54)):
    corners = np.array([[left, -0.09, 0.0], [right, -0.09, 0.0], [right, 0.09, 0.0], [left, 0.09, 0.0]])
    return Layer(name, layer, corners, np.array([[0, 1, 2], [0, 2, 3]]), colour)


def tumour(centre=(0.0, 0.0, -0.02), radius=0.012):
    return ball("tumour", TUMOUR, centre, radius)


def seen(edge=0.09, *more):
    """Cortex as far as `edge` to the right, and drape beyond it."""
    layers = [sheet("cortex", CORTEX, -0.09, edge)]
    layers += [sheet("drape", DRAPE, edge, 0.1, (0.16, 0.36, 0.42))] * (edge < 0.09)
    return render(CAMERA, [*layers, *more], Lamp(np.array([0.05, 0.0, 0.3]), np.zeros(3), 0.1))


@pytest.mark.parametrize("style", DRAWN)
def test_every_style_draws_registered_outline_and_error_band(style):
    picture, at = seen(), tumour()
    shown = composite(picture, CAMERA, at, style=style, cover=Occluders(opening=OPENING)).colour
    mask = compute_silhouette(CAMERA, at.vertices, at.triangles)
    words = (shown == np.asarray(WHITE, np.uint8)).all(axis=2)
    others = words | find_colour(shown, RING_COLOUR)
    assert measure_outline_distance(shown, average_colour(GREEN), mask, others) < 1.5
    assert measure_outline_distance(shown, average_colour(GREEN), np.roll(mask, 5, axis=1), others) > 3.0
    wide = composite(picture, CAMERA, at, style=style, cover=Occluders(opening=OPENING), marks=Marks(0.004)).colour
    outside = cv2.dilate(mask.astype(np.uint8), np.ones((15, 15))) == 0
    assert 100 < (outside & (wide != shown).any(axis=2)).sum() < 2000
    doubtful = composite(
        picture, CAMERA, at, style=style, cover=Occluders(opening=OPENING), words=ImageText("do not rely on it")
    ).colour
    assert not find_colour(doubtful, average_colour(GREEN)).any()


@pytest.mark.parametrize("style", DRAWN)
def test_only_outlines_are_drawn_over_tools(style):
    probe = ball("tool", TOOL, (0.0, 0.0, 0.012), 0.01, (0.7, 0.7, 0.7))
    picture = seen(0.09, probe)
    gauge = DistanceGauge(np.array([0.0, 0.0, 0.001]), np.array([0.0, 0.0, -0.008]))
    hand = np.zeros(picture.segmentation.shape, bool)
    hand[230:420, 250:300] = True
    marks = Marks(0.002, gauge)
    shown = composite(picture, CAMERA, tumour(), style, Occluders((TOOL,), OPENING, hand), marks).colour
    tool = picture.segmentation == TOOL
    within = compute_silhouette(CAMERA, tumour().vertices, tumour().triangles).astype(np.uint8)
    outline = (cv2.dilate(within, np.ones((49, 49))) - cv2.erode(within, np.ones((9, 9)))) > 0
    kept = tool & ~outline | hand
    assert kept.sum() > 2000 and np.array_equal(shown[kept], picture.colour[kept])
    crossed = (shown != picture.colour).any(axis=2) & tool
    assert crossed.any() and crossed.sum() < 0.2 * tool.sum()  # broken lines alone
    bare = composite(picture, CAMERA, tumour(), style, Occluders(opening=OPENING), marks).colour
    assert (bare[tool] != picture.colour[tool]).any() and (bare[hand] != picture.colour[hand]).any()


@pytest.mark.parametrize("style", DRAWN)
def test_outline_under_drape_is_dashed(style):
    picture, at = seen(0.0), tumour()
    shown = composite(picture, CAMERA, at, style=style, cover=Occluders(opening=OPENING)).colour
    mask, shut = compute_silhouette(CAMERA, at.vertices, at.triangles), picture.segmentation == DRAPE
    outline = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(outline, cv2.findContours(mask.astype(np.uint8), 0, 1)[0], -1, (1,))
    inked = find_colour(shown, average_colour(GREEN)) & (outline > 0)
    far = cv2.dilate(shut.astype(np.uint8), np.ones((9, 9))) == 0
    assert 0.4 < inked[(outline > 0) & shut].mean() < 0.85 and inked[(outline > 0) & far].mean() > 0.95
    within = cv2.erode((mask & shut).astype(np.uint8), np.ones((13, 13))) > 0
    unchanged = (shown == picture.colour).all(axis=2)
    assert unchanged[within].mean() > 0.6  # all but words
    assert all(has_text(shown, line, TEXT_SCALE) for line in ("partly under", "the drape"))
    open_to_all = composite(picture, CAMERA, at, style=style).colour
    assert (find_colour(open_to_all, average_colour(GREEN)) & (outline > 0))[(outline > 0) & shut].mean() > 0.95


def test_opening_describes_tissue_above_the_tumour():
    assert OPENING.describe({CORTEX: 95, DRAPE: 5}) == OPENING.describe({}) == ""
    assert OPENING.describe({CORTEX: 50, DRAPE: 30, 7: 20}) == "partly under the drape"
    assert OPENING.describe({CORTEX: 50, DRAPE: 20, 7: 30}) == "partly seen through bone"
    assert OPENING.describe({DRAPE: 95, CORTEX: 5}) == "under the drape"


def test_depth_style_is_stronger_when_nearer_and_has_a_scale():
    picture = seen(0.0)
    row, column = CAMERA.project(np.array([[-0.004, 0.0, -0.02]]))[0][0, ::-1].round().astype(int)
    red = []
    for depth in (0.015, 0.025, 0.04):
        shown = composite(
            picture,
            CAMERA,
            tumour((0.0, 0.0, -depth), 0.01),
            style="depth",
            cover=Occluders(opening=OPENING),
            words=ImageText(error=2e-3),
        )
        red.append(int(shown.colour[row, column, 0]))
    assert red[0] < red[1] - 10 < red[2] - 20  # less of the cortex's red under more of the tint
    changed = (
        shown.colour
        != composite(
            picture, CAMERA, tumour((0.0, 0.0, -0.04), 0.01), style="contour", cover=Occluders(opening=OPENING)
        ).colour
    ).any(axis=2)
    assert changed[:, 480:].sum() > 1000  # the scale, on the drape


def test_signed_distance_is_nan_beyond_its_limit():
    surface = tumour((0.0, 0.0, 0.0), 0.01)
    turned = replace(surface, triangles=surface.triangles[:, ::-1])
    points = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.005, 0.0], [0.5, 0.0, 0.0]])
    for each in (surface, turned):
        found = compute_signed_distance(build_bvh(each.vertices, each.triangles), points, 0.1)
        assert found[:3] == pytest.approx([-0.01, 0.01, -0.005], abs=2e-4) and np.isnan(found[3])


def test_text_panel_is_placed_outside_hidden_regions():
    colour, hidden = np.full((360, 640, 3), 90, np.uint8), np.zeros((360, 640), np.uint8)
    hidden[:, :400] = 1
    lines = ["a line that is as wide as more than half of the picture, or wider", "another"]
    shown = draw_text_panel(colour, lines, first_row=40, obstacles=[np.ones_like(hidden), hidden])
    changed = (shown != colour).any(axis=2)
    assert changed.any() and not changed[:, :400].any()
    assert np.array_equal(
        draw_text_panel(colour, lines, obstacles=[np.ones_like(hidden)]), draw_text_panel(colour, lines)
    )


def test_occlusion_mask_of_other_size_is_rejected():
    with pytest.raises(ValueError, match="covered"):
        composite(seen(), CAMERA, tumour(), cover=Occluders(occluder_mask=np.zeros((4, 4), bool)))


def test_section_has_letters_at_both_ends_next_to_a_tool():
    at = tumour((0.0, 0.0, -0.014))
    for tool in (False, True):
        picture = seen()
        roles = np.zeros((480, 640), bool)
        roles[:, 360:] = tool
        shown = composite(picture, CAMERA, at, style="cut", cover=Occluders(occluder_mask=roles)).colour
        plain = composite(picture, CAMERA, at, style="contour", cover=Occluders(occluder_mask=roles)).colour
        # The line lies level through the middle, and letters stand above it.
        (middle,), _ = CAMERA.project(at.vertices.mean(axis=0)[None])
        reach = np.ptp(CAMERA.project(at.vertices)[0][:, 0]) / 2.0
        above = slice(round(middle[1]) - 16, round(middle[1]) - 4)
        columns = np.flatnonzero((shown != plain)[above, : round(middle[0] + 1.5 * reach)].any(axis=(0, 2)))
        letters = np.split(columns, np.flatnonzero(np.diff(columns) > 4) + 1)
        assert len(letters) == 2
        assert letters[0][0] < middle[0] - reach
        assert (letters[1][-1] > middle[0] + reach) is not tool and (letters[1][-1] < 360 or not tool)


def test_header_lines_wrap_next_to_a_tool():
    tool = np.zeros((480, 640), bool)
    texts = ["FEM reference (no surrogate)", "tumour position error <= 5.7 mm (95 %), above all registration"]
    assert wrap_header(texts, tool) == texts
    tool[:200, 330:390] = True
    lines = wrap_header(texts, tool)
    assert len(lines) > 2 and " ".join(lines) == " ".join(texts)
    assert max(cv2.getTextSize(line, FONT, TEXT_SCALE, 1)[0][0] for line in lines) < 330
    tool[:, 40:] = True
    assert wrap_header(texts, tool) == texts  # there is no room beside it


def test_ring_caption_is_separated_from_the_tip_distance():
    """Directly below the number the caption would look like its explanation."""
    at, said = tumour((0.0, 0.0, -0.014)), "rings: mm to the surface; error not known"
    tip = CAMERA.unproject(np.array([[440.0, 20.0]]), np.array([0.2]))[0]
    shown = composite(
        seen(0.01),
        CAMERA,
        at,
        style="rings",
        cover=Occluders(opening=OPENING),
        marks=Marks(gauge=DistanceGauge(tip, at.vertices[0])),
    ).colour
    number = find_text(shown, str(DistanceGauge(tip, at.vertices[0])), NUMBER_SCALE)
    caption = find_text(shown, wrap_line(said, 0.3 * 640)[0], TEXT_SCALE)
    assert number is not None and caption is not None
    left, top, right, foot = number
    assert (
        caption[1] > foot + LINE_SPACING
        or caption[3] < top - LINE_SPACING
        or caption[0] > right + LINE_SPACING
        or caption[2] < left - LINE_SPACING
    )


@pytest.mark.parametrize(("covered", "middle"), [(460, -0.014), (640, -0.014), (0, 0.3)])
def test_section_inset_is_drawn_unless_the_image_is_covered(covered, middle):
    """Cases: a hand covers all visible parts or the whole image, or all parts are behind the camera."""
    hand = np.zeros((480, 640), bool)
    hand[:, :covered] = True
    at = tumour((0.0, 0.0, middle))
    over = composite(seen(0.01), CAMERA, at, style="cut", cover=Occluders(opening=OPENING, occluder_mask=hand))
    assert (over.taken == SHEET_VALUE).any() == (covered < 640)
