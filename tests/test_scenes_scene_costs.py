"""Label above an image and tiled images of a scene: source, time, motion and warnings."""

from dataclasses import replace

import numpy as np
from theatres import player, short

from ar.screen import shrink_image
from scenes.play.scene_costs import draw_cost_panel, tile_images
from scenes.play.stage import TOOL
from scenes.script.tool_paths import Touch
from sim.deformation import Outcome


def test_cost_label_does_not_cover_the_tool(play):
    frame = play.draw(51, 1.7, play.scene.path(1.7))
    plain = draw_cost_panel(frame, "linear")
    assert plain.shape == frame.shown.shape
    changed, tool = (plain != frame.shown).any(axis=2), frame.picture.segmentation == TOOL
    assert changed.any() and tool.any() and not changed[tool].any()


def test_cost_label_has_source_time_and_motion(play, monkeypatch):
    said = []
    monkeypatch.setattr(
        "scenes.play.scene_costs.draw_text_panel", lambda colour, lines, **more: said.extend(lines) or colour
    )
    frame = replace(play, motion_error=None).draw(51, 1.7, play.scene.path(1.7))
    draw_cost_panel(frame, "linear")
    assert said[:2] == [f"linear: tumour moved {1e3 * frame.moved:.2f} mm", f"t 1.70 s, {frame.acts}"]
    assert said[-1] == frame.deformation.source
    draw_cost_panel(replace(frame, moved=1.33e-3, moved_error=5.31e-3), "linear")
    assert "linear: tumour moved 1.33 +- 5.4 mm" in said


def test_cost_label_warns_of_extrapolated_solution(theatre, monkeypatch):
    shown = []
    monkeypatch.setattr(
        "scenes.play.scene_costs.draw_text_panel", lambda colour, lines, **more: shown.append(list(lines)) or colour
    )
    play = player(theatre, short(), "linear")
    for force in (0.2, 0.6):
        draw_cost_panel(play.draw(0, 0.0, Touch(force=force)), "linear")
    within, beyond = shown
    assert beyond[1] == Outcome.EXTRAPOLATED.value and len(beyond) == len(within) + 1


def test_shrunken_image_keeps_mean_brightness():
    colour = np.random.default_rng(0).integers(0, 256, (8, 10, 3), dtype=np.uint8)
    small = shrink_image(colour, colour.shape[1] // 2, colour.shape[0] // 2)
    assert small.shape == (4, 5, 3)
    np.testing.assert_allclose(small[1, 2], colour[2:4, 4:6].reshape(4, 3).mean(axis=0), atol=0.51)
    assert tile_images([small] * 4).shape == (8, 15, 3) and (tile_images([small] * 4)[4:, 5:] == 12).all()
