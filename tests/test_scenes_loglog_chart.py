"""Log-log charts: positions of curves, dots and labels, and rejected values."""

import re
import sys

import numpy as np
import pytest

from scenes.analysis.loglog_chart import HEIGHT, PALE_OPACITY, WIDTH, ChartPanel, Curve, Dot, draw_panels, draw_svg
from scenes.cli import main

FULL = np.array([31, 119, 180])
"""First colour of matplotlib's cycle."""


def panel(*points, marks=()):
    """Panel without a legend, as its curve has no name."""
    return ChartPanel("title", "nodes", "seconds", (Curve("", points),), marks)


def ink(picture, colour):
    """Rows and columns (n, 2) of the pixels of a colour."""
    return np.argwhere((np.abs(picture.astype(int) - colour) < 12).all(axis=-1))


def test_power_law_points_lie_on_a_straight_line():
    rows, columns = ink(draw_panels([panel((1e1, 1e0), (1e2, 1e1), (1e3, 1e2))]), FULL).T
    assert np.ptp(columns) > 0.6 * WIDTH and np.ptp(rows) > 0.6 * HEIGHT
    slope, start = np.polyfit(columns, rows, 1)
    assert slope < 0.0
    assert np.abs(rows - slope * columns - start).max() < 6.0


def test_panels_are_side_by_side_and_deterministic():
    one = panel((1.0, 2.0), marks=((1.5, "here"),))
    picture = draw_panels([one, one])
    assert picture.shape == (HEIGHT, 2 * WIDTH, 3) and picture.dtype == np.uint8
    np.testing.assert_array_equal(*np.split(picture, 2, axis=1))
    np.testing.assert_array_equal(picture, draw_panels([one, one]))


@pytest.mark.parametrize("points", [(), ((0.0, 1.0),), ((1.0, -1.0),)])
def test_chart_rejects_non_positive_values_and_no_panels(points):
    with pytest.raises(ValueError, match="positive"):
        draw_panels([panel(*points)])
    with pytest.raises(ValueError, match="nothing"):
        draw_panels([])


def test_dots_have_data_positions_and_given_opacity():
    points = ((1e1, 1e0), (1e2, 1e1), (1e3, 1e2))
    dots = tuple(Dot("", "", x, y, is_pale=x == 1e2) for x, y in points)
    picture = draw_panels([ChartPanel("title", "x", "y", dots=dots)])
    full, pale = ink(picture, FULL), ink(picture, PALE_OPACITY * FULL + (1.0 - PALE_OPACITY) * 255.0)
    centre = (full.min(axis=0) + full.max(axis=0)) / 2.0
    assert np.allclose(np.median(pale, axis=0), centre, atol=1.5)
    assert full[:, 0].min() < centre[0] - 50


def test_labels_of_adjacent_dots_do_not_overlap():
    """Two labels at touching dots have as many dark pixels as both drawn separately."""

    def dark(*names):
        dots = tuple(Dot(name, "g", 10.0 + 0.5 * k, 1.0) for k, name in enumerate(names))
        return int((draw_panels([ChartPanel("t", "x", "y", dots=dots)]) < 110).all(axis=-1).sum())

    bare = dark("", "")
    assert dark("horse", "tiger") - bare > 0.95 * (dark("horse", "") - bare + dark("", "tiger") - bare)


def test_pale_dot_in_a_dense_cluster_has_no_label():
    """In a cluster of 60 dots; the dot in full colour keeps its label."""

    def picture(pale, full, crowd=60):
        pales = [Dot(pale, "g", 10.0 + 0.01 * k, 1.0 + 0.01 * k, is_pale=True) for k in range(crowd)]
        return draw_panels([ChartPanel("t", "x", "y", dots=(*pales, Dot(full, "g", 10.3, 1.3)))])

    def changed(one, other):
        return (one != other).any(axis=-1).sum()

    assert changed(picture("horse", ""), picture("", "")) < 20 * changed(picture("horse", "", 1), picture("", "", 1))
    assert changed(picture("horse", "tiger"), picture("horse", ""))


def test_svg_chart_has_dot_tooltips_and_pareto_front():
    dots = tuple(Dot(f"row {k}", "g", 10.0**k, 10.0**-k, hint=f"<{k}> ms", y_range=(1e-3, 10.0)) for k in range(3))
    bare, text = (
        draw_svg(ChartPanel("t", "x", "y", dots=dots, front=front)) for front in ((), ((1.0, 1.0), (10.0, 0.1)))
    )
    assert text.startswith("<svg") and "http" not in text.split("</defs>")[0]
    assert re.findall(r'<g id="dot-\d"><title>([^<]*)</title>', text) == [f"&lt;{k}&gt; ms" for k in range(3)]
    assert text.count("<path") == bare.count("<path") + 1


def test_panels_have_their_given_size():
    panels = [ChartPanel("t", "x", "y", dots=(Dot("one", "g", 1.0, 2.0),), size=(300 + 100 * k, 360)) for k in range(2)]
    assert draw_panels(panels).shape == (360, 700, 3)


def test_missing_matplotlib_message_names_the_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib.axes", None)
    for name in ("loglog_chart", "factorial"):
        monkeypatch.delitem(sys.modules, f"scenes.analysis.{name}", raising=False)
    assert main(["sensitivity", "--factorial"]) == 2
    assert "pip install -e '.[report]'" in capsys.readouterr().err


def test_group_has_the_same_colour_in_each_chart():
    dots = (Dot("", "b", 1.0, 1.0),)
    alone, listed = (draw_svg(ChartPanel("t", "x", "y", dots=dots, groups=names)) for names in ((), ("a", "b")))
    assert "#1f77b4" in alone and "#ff7f0e" not in alone and ">a<" not in listed
    assert "#ff7f0e" in listed and "#1f77b4" not in listed
