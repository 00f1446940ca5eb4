"""Charts with logarithmic axes, drawn by matplotlib as images or SVG."""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from sim.runtime.optional_packages import require_extra

with require_extra("report", "a chart needs"):
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator
    from matplotlib.transforms import Bbox

WIDTH, HEIGHT = 640, 480  # Default size of a chart [pixel].
DPI = 100  # Resolution of a chart [pixel/inch].
PALE_OPACITY = 0.35  # Opacity of pale dots.
NAME_GREY = "0.45"  # Grey level of pale names, 0 to 1.
DOT_DIAMETER = 7.0  # Diameter of a dot [pt].
NAME_BACKGROUND = {"facecolor": "white", "alpha": 0.7, "pad": 0.0, "linewidth": 0.0}  # Box behind a name.
NAME_DISTANCE = 6.0  # Distance of a name from the centre of its dot [pt].
SIDES = ((1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (1, 1), (-1, -1), (-1, 1))
"""Positions of a name relative to its dot (right, up), in order of preference."""
# Matplotlib's text alignment, horizontal and vertical, by the side of the dot.
HORIZONTAL_ALIGNMENT, VERTICAL_ALIGNMENT = {-1: "right", 0: "center", 1: "left"}, {-1: "top", 0: "center", 1: "bottom"}


@dataclass(frozen=True)
class Curve:
    """Named curve through points (x, y) with positive coordinates."""

    name: str
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Dot:
    """Dot at (x, y), both positive, with a label, in the colour of its group; pale if `is_pale`.

    `y_range`: ends of a vertical bar; `hint`: text that appears if the mouse pointer is over the dot.
    """

    name: str
    group: str
    x: float
    y: float
    is_pale: bool = False
    y_range: tuple[float, float] | None = None
    hint: str = ""


@dataclass(frozen=True)
class ChartPanel:
    """Chart with one pair of axes: title, axis labels, curves, dots, and labelled vertical lines (`marks`: x, label).

    `size`: width and height [pixel]; `y_range`: limits of the y axis (None: range of the data with a margin); `front`:
    points that are joined by a stepped line; `groups`: groups of dots in the order of colours (others follow).
    """

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...] = ()
    marks: tuple[tuple[float, str], ...] = ()
    dots: tuple[Dot, ...] = ()
    size: tuple[int, int] = (WIDTH, HEIGHT)
    y_range: tuple[float, float] | None = None
    front: tuple[tuple[float, float], ...] = ()
    groups: tuple[str, ...] = ()


def draw_panels(panels: Sequence[ChartPanel]) -> np.ndarray:
    """Draw panels of equal height side by side; return an image (height, sum of widths, 3) uint8.

    Raises
    ------
    ValueError
        There is no panel, or a panel has no points or a point that is not positive.
    """
    if not panels:
        raise ValueError("a chart without panels shows nothing: give at least one.")
    return np.hstack([_draw_panel(panel) for panel in panels])


def draw_svg(panel: ChartPanel) -> str:
    """Draw a panel as an SVG element for HTML, in which dots show their `hint`.

    Raises
    ------
    ValueError
        The panel has no points, or a point that is not positive.
    """
    canvas = _build_canvas(panel)
    canvas.draw()
    canvas.figure.set_layout_engine("none")  # names and axes keep their positions at this resolution
    text = format_svg(canvas.figure)
    for number, dot in enumerate(panel.dots):
        mark = f'<g id="dot-{number}">'
        text = text.replace(mark, f"{mark}<title>{escape(dot.hint or dot.name)}</title>", 1)
    return text


def format_svg(figure: Figure) -> str:
    """Format a figure as an SVG element for HTML, without metadata; equal figures have equal texts."""
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "sulcus"}), io.StringIO() as file:
        figure.savefig(file, format="svg", metadata={"Date": None})
        text = file.getvalue()
    return re.sub(
        r"<metadata>.*?</metadata>|\sxmlns(:xlink)?=\"[^\"]*\"", "", text[text.index("<svg") :], flags=re.DOTALL
    )


def _draw_panel(panel: ChartPanel) -> np.ndarray:
    canvas = _build_canvas(panel)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _build_canvas(panel: ChartPanel) -> FigureCanvasAgg:
    pairs = [point for curve in panel.curves for point in curve.points] + [(dot.x, dot.y) for dot in panel.dots]
    pairs += [(dot.x, y) for dot in panel.dots for y in dot.y_range or ()]
    points = np.array(pairs, float).reshape(-1, 2)
    if not len(points) or not (points > 0.0).all():
        raise ValueError(f"{panel.title}: logarithmic axes show positive numbers, and at least one point.")
    figure = Figure((panel.size[0] / DPI, panel.size[1] / DPI), DPI, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
    x_range, y_range = _compute_axis_limits(points[:, 0]), panel.y_range or _compute_axis_limits(points[:, 1])
    axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y, xscale="log", yscale="log", xlim=x_range, ylim=y_range)
    for axis, (low, high) in ((axes.xaxis, x_range), (axes.yaxis, y_range)):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)) if high / low < 1e3 else NullLocator())
        axis.set_minor_formatter("{x:g}")
    axes.grid(which="both", color="0.9")
    axes.set_axisbelow(True)
    for x, name in (mark for mark in panel.marks if x_range[0] < mark[0] < x_range[1]):
        axes.axvline(x, color=NAME_GREY, linestyle="--", linewidth=1.0)
        place = (x, 0.0), (-5, 8), ("data", "axes fraction"), "offset points"
        axes.annotate(name, *place, color=NAME_GREY, size="small", ha="right")
    for curve in panel.curves:
        axes.plot(*np.array(sorted(curve.points)).reshape(-1, 2).T, marker="o", markersize=5, label=curve.name)
    found = [dot.group for dot in panel.dots]
    groups = {group: f"C{number}" for number, group in enumerate(dict.fromkeys((*panel.groups, *found)))}
    for group in sorted(set(found), key=list(groups).index):
        axes.plot([], [], "o", color=groups[group], markersize=DOT_DIAMETER, label=group)
    if panel.front:
        axes.step(*np.array(sorted(panel.front)).T, where="post", color=NAME_GREY, linewidth=1.0, zorder=1)
    for number, dot in sorted(enumerate(panel.dots), key=lambda each: not each[1].is_pale):  # pale ones are covered
        colour, opacity = groups[dot.group], PALE_OPACITY if dot.is_pale else 1.0
        if dot.y_range:
            axes.vlines(dot.x, *dot.y_range, color=colour, linewidth=1.0, alpha=0.6 * opacity)
        (drawn,) = axes.plot(dot.x, dot.y, "o", color=colour, markersize=DOT_DIAMETER, markeredgewidth=0, alpha=opacity)
        drawn.set_gid(f"dot-{number}")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize="small")
    if panel.dots:
        canvas.draw()
        _write_names(axes, panel.dots)
    return canvas


def _write_names(axes: Axes, dots: Sequence[Dot]) -> None:
    """Write the name of each dot at the side with the fewest overlaps; omit names of pale dots that would overlap."""
    reach = 0.5 * DOT_DIAMETER * DPI / 72.0
    centres = axes.transData.transform([(dot.x, dot.y) for dot in dots])
    taken = [Bbox([centre - reach, centre + reach]) for centre in centres]
    legend, frame = axes.get_legend(), axes.get_window_extent()
    taken += [legend.get_window_extent()] if legend else []
    for dot in sorted((dot for dot in dots if dot.name), key=lambda dot: dot.is_pale):
        names = [
            axes.annotate(
                dot.name,
                (dot.x, dot.y),
                (NAME_DISTANCE * right, NAME_DISTANCE * up),
                textcoords="offset points",
                size="small",
                bbox=NAME_BACKGROUND,
            )
            for right, up in SIDES
        ]
        for name, (right, up) in zip(names, SIDES, strict=True):
            name.set(
                ha=HORIZONTAL_ALIGNMENT[right], va=VERTICAL_ALIGNMENT[up], color=NAME_GREY if dot.is_pale else "black"
            )
        boxes = [name.get_window_extent() for name in names]
        overlaps = [box.count_overlaps(taken) + (not _is_within(box, frame)) for box in boxes]
        best = int(np.argmin(overlaps))
        is_kept = not (dot.is_pale and overlaps[best])
        for number, name in enumerate(names):
            if number != best or not is_kept:
                name.remove()
        taken += [boxes[best]] if is_kept else []


def _is_within(box: Bbox, frame: Bbox) -> bool:
    return frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1


def _compute_axis_limits(values: np.ndarray) -> tuple[float, float]:
    """Compute the limits of a logarithmic axis: the range of the values with a margin, at least one decade."""
    low, high = float(values.min()) / 1.4, float(values.max()) * 1.4
    spare = max(10.0 * low / high, 1.0) ** 0.5
    return low / spare, high * spare
