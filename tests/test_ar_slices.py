"""What stands beside the 3-D view: slices of a scan, the last seconds as a chart; and who leads, and films."""

import re

import cv2
import numpy as np
import pytest

from ar.page.history import SPAN, History, Line, Sample, ceiling
from ar.page.lead import IDLE, Lead
from ar.page.recording import LONGEST, RATE, Recording, played
from ar.page.sight import coded
from ar.page.slices import PLANES, REACH, SIDE, Cut, resampled, section, sliced, view, within
from ar.rendering.layer import Layer, Solid
from scenes.script.tool import sphere

PITCH = 2.0 * REACH / SIDE


def ball(radius: float, middle=(0.0, 0.0, 0.0), colour=(0.3, 0.95, 0.55)) -> Layer:
    points, triangles = sphere()
    return Layer("ball", 4, np.asarray(middle) + radius * points, triangles, colour)


class TestSection:
    def test_a_ball_is_cut_in_a_circle(self):
        """Closed, on the plane, and of the radius that Pythagoras says."""
        layer, normal = ball(12e-3), np.array([0.6, 0.0, 0.8])
        (line,) = section(layer.vertices, layer.triangles, 5e-3 * normal, normal)
        assert np.array_equal(line[0], line[-1]) and len(line) > 30
        assert np.abs(line @ normal - 5e-3).max() < 1e-12
        away = np.linalg.norm(line - 5e-3 * normal, axis=1)
        assert np.allclose(away, np.sqrt(12e-3**2 - 5e-3**2), rtol=0.02)

    def test_each_part_is_a_line_and_what_is_not_cut_is_none(self):
        two = [ball(5e-3), ball(5e-3, (20e-3, 0.0, 0.0))]
        vertices = np.concatenate([layer.vertices for layer in two])
        triangles = np.concatenate([two[0].triangles, two[1].triangles + len(two[0].vertices)])
        assert len(section(vertices, triangles, np.zeros(3), np.array([0.0, 0.0, 1.0]))) == 2
        assert section(vertices, triangles, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])) == []

    def test_an_open_surface_is_cut_in_an_open_line(self):
        corners = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
        (line,) = section(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        assert sorted(line[[0, -1], 0]) == [0.0, 1.0] and len(line) == 3


class TestViews:
    @pytest.mark.parametrize("plane", PLANES, ids=lambda plane: plane.name)
    def test_the_scan_is_where_its_affine_says(self, plane):
        """A volume whose grey grows along R, A or S grows that way in the view, by as much."""
        for axis in range(3):
            index = np.indices((51, 51, 51))[axis] / 50.0
            scan = Solid(index.astype(np.float32), np.linalg.inv(np.array(np.diag([2e-3, 2e-3, 2e-3, 1.0]) - OFF)))
            found = resampled(plane, scan, np.zeros(3)).astype(float)
            across, down = (found[:, 200] - found[:, 80]).mean(), (found[200] - found[80]).mean()
            wanted = 190.0 * 120.0 * PITCH / 0.1
            assert across == pytest.approx(wanted * plane.right[axis], abs=1.5)
            assert down == pytest.approx(wanted * plane.down[axis], abs=1.5)

    def test_the_band_is_as_wide_as_the_error(self):
        inside = within(PLANES[0], np.zeros(3), ball(15e-3), 5e-3)
        row = np.flatnonzero(inside[SIDE // 2])
        widths = [len(part) * PITCH for part in np.split(row, np.flatnonzero(np.diff(row) > 1) + 1)]
        assert widths == pytest.approx([10e-3, 10e-3], abs=1e-3)

    def test_where_the_error_is_not_known_or_the_place_is_doubtful_there_is_no_band(self):
        known = Cut(ball(12e-3), ball(12e-3, (2e-3, 0.0, 0.0)), 4e-3)
        green = [np.count_nonzero(tinted(view(PLANES[0], None, np.zeros(3), cut))) for cut in (
            known, Cut(known.now, known.before), Cut(known.now, known.before, 4e-3, True)
        )]  # fmt: skip
        assert green[0] > 2 * green[1] > 0 and green[2] == 0

    def test_three_views_stand_side_by_side_also_of_nothing(self):
        none = Layer("tumour", 4, np.zeros((0, 3)), np.zeros((0, 3), int))
        for cut in (
            Cut(ball(12e-3), ball(12e-3), 1e-3, tip=np.zeros(3), others=[ball(3e-3)]),
            Cut(none, ball(1e-2), 1e-3),
        ):
            assert sliced(None, np.zeros(3), cut).shape == (SIDE, 3 * SIDE, 3)


OFF = np.array([[0, 0, 0, 5e-2], [0, 0, 0, 5e-2], [0, 0, 0, 5e-2], [0, 0, 0, 0.0]])


def tinted(colour: np.ndarray) -> np.ndarray:
    """(H, W) bool: the pixels that are greener than red."""
    return colour[..., 1].astype(int) > colour[..., 0].astype(int) + 10


class TestHistory:
    def test_the_chart_is_of_the_last_seconds_with_the_error_as_a_band(self):
        history = History((Line("distance", "mm", "#fff"), Line("force", "N", "#f00")))
        for time in np.arange(0.0, 60.0, 0.1):
            history.add(Sample(float(time), (10.0, None), (2.0 if time < 50.0 else None, None)))
        assert history.samples[0].time >= 59.9 - SPAN - 1e-9
        chart = history.chart()
        (band,) = re.findall(r'<polygon points="([^"]*)"', chart)
        heights = {float(point.split(",")[1]) for point in band.split()}
        # Of 20 units, 8 to 12 are 4.
        assert len(heights) == 2 and max(heights) - min(heights) == pytest.approx(69.0 * 4.0 / 20.0, abs=0.2)
        assert chart.count("<polyline") == 2 and chart.count("stroke-dasharray") == 1
        assert "force: not known" in chart and "distance [mm]" in chart and 'role="img"' in chart

    def test_before_anything_is_read_it_is_an_empty_chart(self):
        chart = History((Line("a<b", "mm", "#fff"),)).chart()
        assert "<polyline" not in chart and "nothing yet" in chart

    def test_a_moment_alone_is_a_dot_and_nothing_is_drawn_across_what_is_not_known(self):
        history = History((Line("distance", "mm", "#fff"),))
        for time, value in ((0.0, 3.0), (5.0, 4.0), (6.0, 4.0), (7.0, None), (8.0, 5.0)):
            history.add(Sample(time, (value,), (None,)))
        history.break_off(8.5)
        history.add(Sample(9.0, (6.0,), (None,)))
        lines = [line.split() for line in re.findall(r'<polyline points="([^"]*)"', history.chart())]
        assert [len(line) for line in lines] == [2] * 4
        widths = [float(line[1].split(",")[0]) - float(line[0].split(",")[0]) for line in lines]
        assert widths == pytest.approx([3.3, 27.5, 3.3, 3.3], abs=0.11)
        history.samples.clear()
        history.add(Sample(9.0, (None,), (None,)))
        assert ">not known<" in history.chart()

    def test_scales_end_at_round_numbers(self):
        assert [ceiling(value) for value in (0.0, 0.3, 1.0, 1.2, 9.0, 13.9)] == [1.0, 0.5, 1.0, 2.0, 10.0, 20.0]


class TestLead:
    def test_the_lead_passes_to_who_asked_first_and_else_to_who_is_here_longest(self):
        lead = Lead()
        lead.see({2, 3, 4}, 0.0)
        assert lead.leader == 2 and lead.act(2, 1.0) and not lead.act(3, 1.0)
        for visitor in (4, 3):
            lead.ask(visitor, 2.0)
        assert lead.leader == 2 and "Visitor 4 asks" in lead.words(2, {2, 3, 4}) and "asked" in lead.words(3, {2, 3, 4})
        lead.see({3, 4}, 3.0)
        assert lead.leader == 4 and lead.asking == (3,)
        lead.give(4.0)
        assert lead.leader == 3
        lead.see({4, 5}, 5.0)
        assert lead.leader == 4 and not lead.words(4, {4})

    def test_who_does_nothing_for_long_hands_over_on_being_asked(self):
        lead = Lead()
        lead.see({1, 2}, 0.0)
        lead.act(1, 10.0)
        lead.ask(2, 10.0 + IDLE)
        assert lead.leader == 2 and lead.asking == ()


class TestRecording:
    def test_a_film_shows_each_picture_as_long_as_the_page_did(self):
        codes = [coded(np.full((48, 64, 3), grey, np.uint8)) for grey in (0, 100, 200)]
        shown = list(played([(5.0, codes[0]), (6.0, codes[1]), (6.2, codes[2])], 7.0, 10.0))
        assert [round(float(picture.mean()), -2) for picture in shown] == [0.0] * 10 + [100.0] * 2 + [200.0] * 8

    def test_it_is_an_mp4_that_can_be_read_and_of_bounded_length(self, tmp_path):
        recording = Recording(0.0)
        for number in range(20):
            recording.take(coded(np.full((48, 64, 3), 10 * number, np.uint8)), 0.1 * number)
        recording.take(coded(np.zeros((48, 64, 3), np.uint8)), LONGEST + 1.0)
        assert len(recording.taken) == 20 and recording.full(LONGEST)
        (tmp_path / "film.mp4").write_bytes(recording.film(2.0))
        film = cv2.VideoCapture(str(tmp_path / "film.mp4"))
        assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 2 * RATE
        assert film.read()[1].shape == (48, 64, 3)

    def test_of_nothing_there_is_no_film(self):
        with pytest.raises(ValueError, match="at least one picture"):
            Recording(0.0).film(1.0)
