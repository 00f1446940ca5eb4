"""Rendered image and its overlay: order, registration, occlusion."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from ar.optics.camera import look_at
from ar.overlay.composite import DOUBTFUL_COLOUR, WARNING_COLOUR, composite, format_warning
from ar.overlay.gauge import NUMBER_SCALE, DistanceGauge
from ar.overlay.hud import HEAD_ROW, LINE_SPACING, TEXT_SCALE, draw_text_panel, write_text
from ar.overlay.marks import BEFORE_COLOUR, ImageText, Marks, Occluders
from ar.overlay.outlines import average_colour, compute_iou, compute_silhouette, has_text, measure_outline_distance
from ar.rendering.layer import Layer, Solid
from ar.rendering.renderer import Lamp, build_lamp, render

CORTEX, TOOL, TUMOUR = 1, 2, 3
EYE = np.array([0.0, -0.05, 0.25])


def camera(width: int = 200, height: int = 150):
    return look_at(EYE, np.zeros(3), np.array([0.0, 1.0, 0.0]), np.radians(25.0), width, height)


def sheet(count: int = 30, half: float = 0.09) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(*[np.linspace(-half, half, count)] * 2, indexing="ij")
    vertices = np.stack([x, y, 0.0 * x], -1).reshape(-1, 3)
    index = np.arange(count * count).reshape(count, count)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def ball(centre, radius: float, rings: int = 20) -> tuple[np.ndarray, np.ndarray]:
    polar, turn = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1)
    index = np.arange(points[..., 0].size).reshape(polar.shape)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
    return points.reshape(-1, 3) * radius + centre, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def cortex(**look) -> Layer:
    return Layer("cortex", CORTEX, *sheet(), **({"colour": (0.9, 0.6, 0.6)} | look))


def tool(centre=(0.02, 0.0, 0.012)) -> Layer:
    return Layer("tool", TOOL, *ball(centre, 0.01), colour=(0.7, 0.7, 0.7), casts_shadow=True)


def tumour(centre=(0.0, 0.0, -0.02), radius: float = 0.012) -> Layer:
    return Layer("tumour", TUMOUR, *ball(centre, radius), colour=(0.2, 0.9, 0.3))


LAMP = build_lamp(camera(), np.zeros(3))


def test_rendered_image_has_colour_depth_and_segmentation():
    here = camera()
    picture = render(here, [cortex(), tool()], LAMP)
    assert picture.colour.shape == (150, 200, 3) and picture.colour.dtype == np.uint8
    middle, _ = here.project(np.zeros(3))
    row, column = np.round(middle[::-1]).astype(int)
    assert picture.segmentation[row, column] == CORTEX
    assert picture.depth[row, column] == pytest.approx(np.linalg.norm(EYE), rel=1e-2)
    empty = picture.segmentation == 0
    assert (picture.depth[empty] == 0.0).all() and (picture.depth[~empty] > 0.0).all()


def test_nearer_layer_is_visible_in_any_layer_order():
    one = render(camera(), [cortex(), tool()], LAMP)
    other = render(camera(), [tool(), cortex()], LAMP)
    assert np.array_equal(one.segmentation, other.segmentation)
    assert (one.segmentation == TOOL).any()
    assert np.array_equal(one.colour, other.colour)


def test_shading_is_independent_of_triangle_orientation():
    there = cortex()
    turned = replace(there, triangles=there.triangles[:, ::-1])
    one, other = (render(camera(), [layer], LAMP) for layer in (there, turned))
    assert np.abs(one.colour.astype(int) - other.colour).max() <= 1


def test_tool_casts_a_shadow_on_the_cortex():
    shadowless = replace(tool(), casts_shadow=False)
    with_shadow, without = (render(camera(), [cortex(), layer], LAMP) for layer in (tool(), shadowless))
    darker = without.colour.astype(int).sum(-1) - with_shadow.colour.astype(int).sum(-1)
    on_cortex = with_shadow.segmentation == CORTEX
    assert np.count_nonzero(darker[on_cortex] > 60) > 50
    assert np.abs(darker[~on_cortex]).max() < 60
    # The lamp stands to the left and above: the shadow falls to the right of the tool and below it.
    rows, columns = np.nonzero(on_cortex & (darker > 60))
    tool_rows, tool_columns = np.nonzero(with_shadow.segmentation == TOOL)
    assert columns.mean() > tool_columns.mean() and rows.mean() > tool_rows.mean()


def test_flat_surface_casts_no_shadow_on_itself():
    """Under a distant lamp a flat sheet looks the same with and without casting shadows."""
    lamp = Lamp(np.array([-0.2, 0.1, 0.3]), np.zeros(3), 0.1)
    one, other = (render(camera(), [cortex(casts_shadow=casts)], lamp).colour.astype(int) for casts in (True, False))
    assert np.abs(one - other).max() <= 1


def test_iou_decreases_with_tumour_displacement():
    here = camera()
    truth = compute_silhouette(here, tumour().vertices, tumour().triangles)
    overlaps = []
    for shift in (0.0, 0.001, 0.003, 0.05):
        moved = tumour((shift, 0.0, -0.02))
        overlaps.append(compute_iou(truth, compute_silhouette(here, moved.vertices, moved.triangles)))
    assert overlaps[0] == 1.0
    assert 1.0 > overlaps[1] > overlaps[2] > overlaps[3] == 0.0
    # Two discs of radius r, d apart: the overlap to first order is 1 - 4 d / (pi r).
    assert overlaps[1] == pytest.approx(1.0 - 4.0 * 0.001 / (np.pi * 0.012), abs=0.03)
    assert compute_iou(truth, compute_silhouette(here.perturb(0.5), tumour().vertices, tumour().triangles)) < 0.9


def test_iou_of_empty_masks_is_zero():
    assert compute_iou(np.zeros((4, 4), bool), np.zeros((4, 4), bool)) == 0.0


def contour_mask(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.abs(before.astype(int) - after).sum(axis=-1) > 40


@pytest.mark.parametrize("style", ["window", "contour", "fill"])
def test_overlay_is_drawn_at_the_tumour_position(style):
    here = camera()
    picture = render(here, [cortex()], LAMP)
    drawn = composite(picture, here, tumour(), style=style)
    changed = contour_mask(picture.colour, drawn.colour)
    rows, columns = np.nonzero(changed)
    middle, _ = here.project(np.array([0.0, 0.0, -0.02]))
    assert [np.mean(columns), np.mean(rows)] == pytest.approx(middle, abs=2.0)
    outline = compute_silhouette(here, tumour().vertices, tumour().triangles)
    assert changed[outline].mean() > (0.2 if style == "contour" else 0.95)
    fresh = render(here, [cortex()], LAMP)
    for same in ("colour", "depth", "segmentation"):
        assert np.array_equal(getattr(picture, same), getattr(fresh, same))


@pytest.mark.parametrize("style", ["window", "contour", "fill"])
def test_tool_occludes_the_overlay(style):
    here = camera()
    picture = render(here, [cortex(), tool((0.0, 0.0, 0.012))], LAMP)
    gauge = DistanceGauge(np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.008]))
    shown = composite(picture, here, tumour(), style=style, cover=Occluders([TOOL]), marks=Marks(0.002, gauge=gauge))
    covered = picture.segmentation == TOOL
    text_free = covered & (np.arange(150) < 100)[:, None]
    assert np.array_equal(shown.colour[text_free], picture.colour[text_free])
    # Without naming the tool as occluder the overlay covers it: the test can fail.
    assert not np.array_equal(
        composite(picture, here, tumour(), style=style).colour[text_free], picture.colour[text_free]
    )
    assert contour_mask(picture.colour, shown.colour)[~covered].any()


def test_margin_line_is_outside_the_contour_by_its_width():
    here = camera()
    picture = render(here, [cortex()], LAMP)
    plain = composite(picture, here, tumour(), style="contour")
    wide = composite(picture, here, tumour(), style="contour", marks=Marks(0.004))
    rows, columns = np.nonzero(np.abs(plain.colour.astype(int) - wide.colour).sum(-1) > 0)
    middle, depth = here.project(np.array([0.0, 0.0, -0.02]))
    radius = np.hypot(columns - middle[0], rows - middle[1]) / here.K[0, 0] * depth
    assert radius.mean() == pytest.approx(0.016, abs=0.001)


@pytest.mark.parametrize("side", [(0.06, 0.0), (-0.06, 0.0), (0.0, 0.04), (0.0, -0.04)])
def test_clipped_margin_is_not_drawn_along_the_image_edge(side):
    here, centre = camera(), (*side, -0.02)
    picture = render(here, [cortex()], LAMP)
    plain, wide = (composite(picture, here, tumour(centre), style="contour", marks=Marks(each)) for each in (0.0, 0.02))
    changed = (plain.colour != wide.colour).any(axis=2)
    edge = np.ones_like(changed)
    edge[3:-3, 3:-3] = False
    assert changed.sum() > 40 and not (changed & edge).any()


def test_header_lines_are_drawn_at_the_top_in_every_style():
    here = camera(320, 240)
    picture = render(here, [cortex()], LAMP)
    for style in ("window", "none"):
        said = composite(
            picture,
            here,
            tumour(),
            style=style,
            marks=Marks(initial=tumour((0.01, 0.0, -0.02))),
            words=ImageText(header=["one", "two"]),
        )
        assert has_text(said.colour[HEAD_ROW : HEAD_ROW + 2 * LINE_SPACING], "one", TEXT_SCALE)
        assert has_text(said.colour[HEAD_ROW + LINE_SPACING - 4 : HEAD_ROW + 3 * LINE_SPACING], "two", TEXT_SCALE)
        assert said.taken[HEAD_ROW + LINE_SPACING, 8:20].all()


def test_deeper_tumour_is_drawn_darker():
    here = camera()
    picture = render(here, [cortex()], LAMP)
    green = [
        composite(picture, here, tumour((0.0, 0.0, -depth), 0.01)).colour[75, 100, 1] for depth in (0.015, 0.03, 0.06)
    ]
    assert green[0] > green[1] > green[2]


def test_gauge_distance_is_euclidean_distance():
    assert DistanceGauge(np.array([0.0, 0.0, 0.0]), np.array([0.003, 0.004, 0.0])).distance == pytest.approx(0.005)


def test_image_label_shows_mean_tumour_displacement():
    """Mean displacement of the surface; the margin is an error of the position, not of the displacement."""
    here, now = camera(400, 300), tumour()
    picture = render(here, [cortex()], LAMP)
    far = np.linspace(0.002, 0.004, len(now.vertices))[:, None] * [1.0, 0.0, 0.0]
    margin = np.linspace(0.0005, 0.0015, len(now.vertices))
    before = replace(now, vertices=now.vertices - far)
    assert has_text(
        composite(picture, here, now, marks=Marks(margin, initial=before)).colour, "moved 3.0 mm", TEXT_SCALE
    )
    assert has_text(composite(picture, here, now, marks=Marks(initial=before)).colour, "moved 3.0 mm", TEXT_SCALE)


def test_motion_arrow_points_to_the_current_tumour_position():
    here, before, now = camera(400, 300), tumour((-0.012, 0.0, -0.02), 0.006), tumour((0.012, 0.0, -0.02), 0.006)
    picture = render(here, [cortex()], LAMP)
    shown = composite(picture, here, now, style="contour", marks=Marks(initial=before)).colour
    grey = np.argwhere((np.abs(shown.astype(int) - average_colour(BEFORE_COLOUR)) <= 2).all(axis=2))[:, ::-1]
    near = [
        np.count_nonzero(np.linalg.norm(grey - here.project(np.array([x, 0.0, -0.02]))[0], axis=1) < 8)
        for x in (-0.012, 0.012)
    ]
    assert near[1] > 1.5 * near[0] > 0


def test_motion_and_warning_are_on_separate_lines():
    """An unknown margin is not drawn."""
    here = camera(400, 300)
    picture = render(here, [cortex()], LAMP)
    before, now = tumour((0.0, 0.0, -0.02)), tumour((0.003, 0.0, -0.02))
    doubt = "outside the training range: do not rely on it"
    shown = composite(picture, here, now, marks=Marks(np.nan, initial=before), words=ImageText(doubt)).colour
    assert has_text(shown, "moved 3.0 mm", TEXT_SCALE)
    assert all(has_text(shown, line, TEXT_SCALE, average_colour(WARNING_COLOUR)) for line in format_warning(doubt, 400))
    assert has_text(
        composite(picture, here, now, marks=Marks(np.nan, initial=before)).colour, "moved 3.0 mm", TEXT_SCALE
    )


def test_unreliable_overlay_is_amber_without_error_margin():
    """The image shows the reason and an amber outline, with neither margin nor +-."""
    here = camera(400, 300)
    picture = render(here, [cortex()], LAMP)
    gauge = DistanceGauge(np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.008]), error=1.2e-3)
    sure = composite(picture, here, tumour(), marks=Marks(0.004, gauge=gauge)).colour
    assert has_text(sure, "8.0 +- 1.2 mm", NUMBER_SCALE) and not has_text(
        sure, "do not rely on it", TEXT_SCALE, average_colour(WARNING_COLOUR)
    )
    unsure, plain = (
        composite(
            picture, here, tumour(), marks=Marks(margin, gauge=gauge), words=ImageText("do not rely on it")
        ).colour
        for margin in (0.004, 0.0)
    )
    assert has_text(unsure, "8.0 mm", NUMBER_SCALE) and has_text(
        unsure, "do not rely on it", TEXT_SCALE, average_colour(WARNING_COLOUR)
    )
    assert np.array_equal(unsure, plain)
    amber, green = (
        (np.abs(unsure.astype(int) - ink) <= 2).all(axis=2).sum()
        for ink in map(average_colour, (DOUBTFUL_COLOUR, (0.2, 0.9, 0.3)))
    )
    assert amber > 20 and green == 0


def test_tumour_outside_the_image_changes_no_pixel():
    here = camera()
    picture = render(here, [cortex()], LAMP)
    for centre in ((1.0, 0.0, 0.0), (0.0, -0.1, 0.6)):
        assert np.array_equal(composite(picture, here, tumour(centre)).colour, picture.colour)


def test_without_overlay_only_the_warning_is_drawn():
    here = camera(400, 300)
    picture = render(here, [cortex()], LAMP)
    gauge = DistanceGauge(np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.008]))
    bare, unsure = (
        composite(
            picture, here, tumour(), style="none", marks=Marks(gauge=gauge, initial=tumour()), words=ImageText(doubt)
        ).colour
        for doubt in ("", "do not rely on it")
    )
    assert np.array_equal(bare, picture.colour) and has_text(
        unsure, "do not rely on it", TEXT_SCALE, average_colour(WARNING_COLOUR)
    )
    rows, columns = np.nonzero((unsure != picture.colour).any(axis=2))
    assert rows.min() > 270 and columns.max() < 120


def test_taken_mask_covers_lines_and_text():
    """All pixels of outline, arrow and number, and no others except a margin around letters."""
    here = camera(400, 300)
    picture = render(here, [cortex()], LAMP)
    gauge = DistanceGauge(np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.008]))
    drawn = composite(
        picture, here, tumour(), style="contour", marks=Marks(gauge=gauge, initial=tumour((0.01, 0.0, -0.02)))
    )
    changed = (drawn.colour != picture.colour).any(axis=2)
    taken = drawn.taken > 0
    halo = cv2.dilate(taken.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert (halo | ~changed).all() and changed[taken].mean() > 0.5
    ring = compute_silhouette(here, tumour().vertices, tumour().triangles).astype(np.uint8)
    assert taken[(ring - cv2.erode(ring, np.ones((3, 3), np.uint8))) > 0].all()


def test_text_is_drawn_inside_the_image():
    for at in ((-50, -50), (1000, 1000), (100, 60)):
        colour = np.full((80, 200, 3), 90, np.uint8)
        write_text(colour, "12.3 mm", at)
        assert np.count_nonzero(colour[2:-2, 2:-2].max(axis=-1) > 200) > 20


def test_text_panel_is_drawn_on_a_copy_of_the_image():
    colour = np.full((150, 200, 3), 90, np.uint8)
    shown = draw_text_panel(colour, ["render 12 ms", "error 0.1 mm"], "bottom right")
    rows, columns = np.nonzero((shown != colour).any(axis=-1))
    assert (colour == 90).all() and rows.min() > 75 and columns.min() > 75
    assert np.array_equal(draw_text_panel(colour, []), colour)


@pytest.mark.parametrize(
    ("attempt", "reason"),
    [
        (lambda: render(camera(), [cortex(), replace(cortex(), name="drape")], LAMP), "own id"),
        (lambda: replace(cortex(), id=0), "id"),
        (lambda: replace(cortex(), rest=np.zeros((900, 3))), "solid"),
        (lambda: replace(cortex(), colour=np.zeros((5, 3))), "colour"),
        (lambda: Solid(np.zeros((1, 5, 5)), np.eye(4)), "voxels"),
        (lambda: composite(render(camera(), [cortex()], LAMP), camera(), tumour(), style="glow"), "window"),
        (lambda: composite(render(camera(), [cortex()], LAMP), camera(100, 75), tumour()), "camera"),
        (lambda: draw_text_panel(np.zeros((9, 9, 3), np.uint8), ["a"], "middle"), "corner"),
    ],
)
def test_invalid_overlay_inputs_are_rejected(attempt, reason):
    with pytest.raises(ValueError, match=reason):
        attempt()


def test_outline_error_counts_misplaced_and_missing_pixels():
    """Cases: an outline shifted by 12 pixels, and one without its right half."""
    here, ink = camera(400, 300), (20.0, 240.0, 60.0)
    true = compute_silhouette(here, tumour().vertices, tumour().triangles)
    nothing = np.zeros(true.shape, bool)

    def gap(*masks, left=400):
        colour = np.zeros((*true.shape, 3), np.uint8)
        for mask in masks:
            colour[mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3))).astype(bool)] = ink
        colour[:, left:] = 0
        return measure_outline_distance(colour, ink, true, nothing)

    middle = int(np.nonzero(true)[1].mean())
    assert gap(true) <= 1.0
    assert 9.0 < gap(true, np.roll(true, 12, axis=1)) <= 12.0
    assert gap(true, left=middle) > 15.0
    assert gap(nothing) == np.inf


def test_text_search_matches_only_whole_lines():
    colour = np.full((80, 200, 3), 90, np.uint8)
    write_text(colour, "11.5 mm", (60, 40))
    found = {text for text in ("11.5 mm", "1.5 mm", "11.6 mm", "5 mm") if has_text(colour, text, 0.5)}
    assert found == {"11.5 mm"} and not has_text(colour, "11.5 mm", 0.45)
