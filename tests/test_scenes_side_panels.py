"""Chart and slices next to the image of the page."""

from dataclasses import replace

import numpy as np
import pytest
from theatres import short, sinking

from scenes.page.side_panels import TIP, TUMOUR_MIDDLE, build_history_sample, list_plot_lines, render_slices
from scenes.script.tool_paths import Touch
from scenes.script.uncertainty import TumourError


def test_chart_and_slices_show_the_current_frame(theatre):
    player = theatre.build_player("linear", short())
    frame = replace(player.draw(3, 0.1, Touch(force=0.25)), tumour_error=TumourError(None))
    read = build_history_sample(replace(frame, distance=12e-3, distance_error=np.inf), player.scene, 5.0)
    assert read.values == pytest.approx((12.0, 0.25)) and read.errors == (None, 0.0) and read.time == 5.0
    assert build_history_sample(replace(frame, distance_error=2e-3), player.scene, 0.0).errors[0] == pytest.approx(2.0)
    middle, tip = (render_slices(frame, player, place) for place in (TUMOUR_MIDDLE, TIP))
    assert middle.shape == tip.shape and (middle != tip).any()
    known = render_slices(replace(frame, tumour_error=TumourError(4e-3)), player, TUMOUR_MIDDLE)
    doubtful = render_slices(replace(frame, tumour_error=TumourError(4e-3), doubt="why"), player, TUMOUR_MIDDLE)
    green = [np.count_nonzero(each[..., 1] > each[..., 0] + 10.0) for each in (known, middle, doubtful)]
    assert green[0] > 1.5 * green[1] > 0 == green[2]
    still = theatre.build_player("fem", sinking())
    assert [line.name for line in list_plot_lines(still.scene)] == ["tumour moved"]
    moved = build_history_sample(replace(frame, moved=3e-3, tumour_error=TumourError(4e-3)), still.scene, 0.0)
    assert moved.values == (3.0,) and moved.errors == (4.0,)
