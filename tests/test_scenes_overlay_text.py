"""Text in a scene's image: no overlap with lines, border or other text, and fixed places."""

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest

import ar.overlay.hud
from ar.overlay.hud import name_edge_directions
from ar.overlay.outlines import compute_silhouette, find_outlines
from ar.overlay.styles import Style
from scenes.page.demo import render_page_image
from scenes.play.deformers import open_theatre
from scenes.play.player import Player, measure_tip_gauge
from scenes.play.stage import TOOL
from scenes.script.scene import find_scene
from scenes.script.tool_paths import Touch

SIZES = (480, 360), (640, 480), (800, 600), (1280, 960)
# So far words stay from lines, from the border, and lines of text from each other [pixel].
LINE, BORDER, WORD = 4, 4, 1
DOUBT = "outside the training range do not rely on it"


@dataclass(frozen=True)
class Written:
    """A line of text in a picture, and its box [pixel]."""

    text: str
    left: int
    top: int
    right: int
    bottom: int

    def grown(self, by: int) -> "Written":
        return Written(self.text, self.left - by, self.top - by, self.right + by, self.bottom + by)

    def meets(self, other: "Written") -> bool:
        aside = self.right <= other.left or other.right <= self.left
        return not (aside or self.bottom <= other.top or other.bottom <= self.top)


@cache
def theatre():
    return open_theatre(device="cpu")


@cache
def answered(name, touch, number):
    """What the best model answers in a scene, whatever the picture's size."""
    play = Player(theatre().build_player("series-gp", find_scene(name)).stage, theatre().models["series-gp"])
    loads = play.build_loads(number, touch)
    return loads, play.compute_deformation(loads)


def seen(monkeypatch, name, size, touch=None, number=51, style="window"):
    """A player, a frame of it, and the lines of text that are written into the frame's picture on the page."""
    scene = find_scene(name)
    scene = replace(scene, viewpoint=replace(scene.viewpoint, width=size[0], height=size[1]))
    play = replace(theatre().build_player("series-gp", scene), style=style)
    found, write = [], cv2.putText

    def heard(colour, text, at, font, scale, ink, *more):
        if len(ink) == 3:  # not the halo
            (width, above), below = cv2.getTextSize(text, font, scale, 1)
            found.append(Written(text, at[0], at[1] - above, at[0] + width, at[1] + below))
        return write(colour, text, at, font, scale, ink, *more)

    monkeypatch.setattr(ar.overlay.hud.cv2, "putText", heard)
    frame = play.draw_frame(number, touch or play.get_touch(number), *answered(name, touch, number), 0.0)
    picture = render_page_image(frame)
    monkeypatch.undo()
    assert picture.shape == (size[1], size[0], 3)
    return play, frame, found


def lined(play, frame):
    """(H, W) bool: pixels of the outlines, of the arrow between their middles, and of the line from the tip."""
    lines = np.zeros(frame.picture.segmentation.shape, np.uint8)
    rest, now = (
        play.stage.build_tumour(at) for at in (play.site.anatomy.mesh.nodes, play.compute_positions(frame.deformation))
    )
    for tumour in (rest, now):
        mask = compute_silhouette(frame.camera, tumour.vertices, tumour.triangles)
        cv2.polylines(lines, find_outlines(mask), True, (1,), 2)
    middles = np.stack([rest.vertices.mean(axis=0), now.vertices.mean(axis=0)])
    for ends in (middles, np.stack([frame.tip, measure_tip_gauge(frame.tip, now).nearest_point])):
        start, end = np.rint(frame.camera.project(ends)[0]).astype(int).tolist()
        if start != end:  # no arrow without motion
            cv2.line(lines, start, end, (1,), 2)
    return (lines > 0) & (frame.picture.segmentation != TOOL)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("name", "touch"),
    [
        ("press", None),
        ("press", Touch()),
        ("press", Touch(-0.03)),
        ("press", Touch(0.03)),
        ("press", Touch(force=1.0)),
        ("press", Touch(force=0.4, tilt=(0.6, 0.0))),
        ("slide", Touch(-0.03)),
        ("draw", Touch(0.008, -0.005, force=0.4)),
    ],
)
def test_image_text_avoids_lines_border_and_other_text(monkeypatch, name, touch, size):
    """On the template with the scene's camera; also for a tool stopped at the bone and for a large force."""
    play, frame, words = seen(monkeypatch, name, size, touch)
    lines, (height, width) = lined(play, frame), frame.shown.shape[:2]
    for word in words:
        box = word.grown(LINE)
        rows, columns = slice(max(box.top, 0), box.bottom), slice(max(box.left, 0), box.right)
        assert not lines[rows, columns].any(), f"{word.text!r} stands on a line"
        assert BORDER <= word.left < word.right <= width - BORDER, word.text
        assert BORDER <= word.top < word.bottom <= height - BORDER, word.text
        assert not [other.text for other in words if other is not word and other.meets(word.grown(WORD))], word.text
        if word.text[0].isdigit():  # the distance leaves the tool in sight
            assert not (frame.picture.segmentation[rows, columns] == TOOL).any()
    said = " ".join(word.text for word in words)
    assert f"frame {frame.number}" in said and "moved " in said
    assert frame.distance is not None and f"{1e3 * frame.distance:.1f}" in said and frame.remark in said
    assert (DOUBT in said) is bool(frame.doubt)
    assert bool(frame.remark) is (touch is not None and abs(touch.x) > 0.02)


@pytest.mark.parametrize("size", SIZES)
def test_direction_letters_and_motion_text_have_fixed_places(monkeypatch, size):
    """For any tool pose: letters a quarter of the width from the corners or halfway up, motion text at the bottom.

    The middle of the top is free for the tool, the middle of the bottom for the tumour.
    """
    width, height = size
    for touch in (None, Touch(), Touch(-0.03), Touch(force=1.0)):
        _, frame, found = seen(monkeypatch, "press", size, touch)
        words = {word.text.split()[0]: word for word in found}
        bearings = name_edge_directions(frame.camera.T_camera_world[:3, :3])
        top, foot, left, right = (words[bearings[edge]] for edge in ("top", "bottom", "left", "right"))
        assert [0.5 * (letter.left + letter.right) / width for letter in (top, foot)] == pytest.approx(
            [0.25, 0.75], abs=0.01
        )
        assert [0.5 * (letter.top + letter.bottom) / height for letter in (left, right)] == pytest.approx(
            [0.5, 0.5], abs=0.02
        )
        moved = words["moved"]
        assert top.top == left.left == moved.left == 8
        assert foot.bottom == moved.bottom == height - 8 and right.right == width - 8


@pytest.mark.parametrize("style", Style.__args__)
def test_warning_is_in_the_image_for_each_overlay_style(monkeypatch, style):
    _, frame, words = seen(monkeypatch, "press", (480, 360), Touch(force=1.0), style=style)
    said = " ".join(word.text for word in words)
    assert frame.doubt and DOUBT in said and ("moved" in said) is (style != "none")
