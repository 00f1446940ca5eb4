import re

from scenes.page.comparison import ComparisonRow
from scenes.page.cost_plot import HEIGHT, WIDTH, format_cost_plot

ROWS = [
    ComparisonRow("gp", 2.0, 0.03, 5, True),
    ComparisonRow("series", 4.0, 0.3, 5, False),
    ComparisonRow("fem", 4000.0, 0.0, 5, True),
]


def test_slower_is_to_the_right_and_a_larger_error_is_higher():
    places = [(float(x), float(y)) for x, y in re.findall(r'circle cx="(\d+)" cy="(\d+)"', format_cost_plot(ROWS))]
    (x0, y0), (x1, y1), (x2, y2) = places
    assert x0 < x1 < x2 and y1 < y0 < y2
    assert all(0 < x < WIDTH and 0 < y < HEIGHT for x, y in places)


def test_fem_is_named_as_the_reference_and_labels_do_not_overlap():
    plot = format_cost_plot([*ROWS, ComparisonRow("near", 2.05, 0.03, 5, False)])
    assert ">FEM (reference)</text>" in plot and "under 0.001 mm" in plot
    low = {name: float(re.search(rf'y="(\d+)" text-anchor="\w+">{name}<', plot)[1]) for name in ("gp", "near")}
    assert abs(low["gp"] - low["near"]) >= 10


def test_a_name_from_a_plugin_stays_text():
    assert "<script>" not in format_cost_plot([ComparisonRow("<script>", 1.0, 1.0, 1, None)])
