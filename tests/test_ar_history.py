"""Chart of the last seconds."""

import re

import numpy as np
import pytest

from ar.page.history import TIME_SPAN, History, Sample, Trace, round_up_scale


class TestHistory:
    def test_chart_shows_last_seconds_with_error_band(self):
        history = History((Trace("distance", "mm", "#fff"), Trace("force", "N", "#f00")))
        for time in np.arange(0.0, 60.0, 0.1):
            history.add(Sample(float(time), (10.0, None), (2.0 if time < 50.0 else None, None)))
        assert history.samples[0].time >= 59.9 - TIME_SPAN - 1e-9
        chart = history.draw_chart()
        (band,) = re.findall(r'<polygon points="([^"]*)"', chart)
        heights = {float(point.split(",")[1]) for point in band.split()}
        # Of 20 units, 8 to 12 are 4.
        assert len(heights) == 2 and max(heights) - min(heights) == pytest.approx(69.0 * 4.0 / 20.0, abs=0.2)
        assert chart.count("<polyline") == 2 and chart.count("stroke-dasharray") == 1
        assert "force: not known" in chart and "distance [mm]" in chart and 'role="img"' in chart

    def test_chart_without_samples_is_empty(self):
        chart = History((Trace("a<b", "mm", "#fff"),)).draw_chart()
        assert "<polyline" not in chart and "nothing yet" in chart

    def test_chart_draws_single_samples_and_keeps_gaps(self):
        history = History((Trace("distance", "mm", "#fff"),))
        for time, value in ((0.0, 3.0), (5.0, 4.0), (6.0, 4.0), (7.0, None), (8.0, 5.0)):
            history.add(Sample(time, (value,), (None,)))
        history.interrupt_lines(8.5)
        history.add(Sample(9.0, (6.0,), (None,)))
        lines = [line.split() for line in re.findall(r'<polyline points="([^"]*)"', history.draw_chart())]
        assert [len(line) for line in lines] == [2] * 4
        widths = [float(line[1].split(",")[0]) - float(line[0].split(",")[0]) for line in lines]
        assert widths == pytest.approx([3.3, 27.5, 3.3, 3.3], abs=0.11)
        history.samples.clear()
        history.add(Sample(9.0, (None,), (None,)))
        assert ">not known<" in history.draw_chart()

    def test_chart_scales_end_at_round_numbers(self):
        assert [round_up_scale(value) for value in (0.0, 0.3, 1.0, 1.2, 9.0, 13.9)] == [1.0, 0.5, 1.0, 2.0, 10.0, 20.0]
