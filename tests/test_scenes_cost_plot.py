import re

from scenes.page.comparison import ComparisonRow
from scenes.page.cost_plot import HEIGHT, WIDTH, format_cost_plot

ROWS = [
    ComparisonRow("gp", 2.0, 0.03, 5, True),
    ComparisonRow("series", 4.0, 0.3, 5, False),
    ComparisonRow("fem", 4000.0, 0.0, 5, True),
]


def test_cost_plot_has_time_to_the_right_and_error_upwards():
    places = [(float(x), float(y)) for x, y in re.findall(r'circle cx="(\d+)" cy="(\d+)"', format_cost_plot(ROWS))]
    (x0, y0), (x1, y1), (x2, y2) = places
    assert x0 < x1 < x2 and y1 < y0 < y2
    assert all(0 < x < WIDTH and 0 < y < HEIGHT for x, y in places)


def test_cost_plot_labels_fem_as_reference_without_overlap():
    plot = format_cost_plot([*ROWS, ComparisonRow("near", 2.05, 0.03, 5, False)])
    assert ">FEM (reference)</text>" in plot and "under 0.001 mm" in plot
    low = {name: float(re.search(rf'y="(\d+)" text-anchor="\w+">{name}<', plot)[1]) for name in ("gp", "near")}
    assert abs(low["gp"] - low["near"]) >= 10


def test_cost_plot_escapes_html_in_names():
    assert "<script>" not in format_cost_plot([ComparisonRow("<script>", 1.0, 1.0, 1, None)])
