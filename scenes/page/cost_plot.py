"""Plot (SVG) of the deformers' errors against their times, on the loads that the page has shown."""

from collections.abc import Sequence
from html import escape

import numpy as np

from .comparison import ComparisonRow

WIDTH, HEIGHT = 340, 150  # Size of the plot [SVG unit].
LEFT, RIGHT, TOP, BOTTOM = 44, 12, 10, 30  # Margins of its axes [SVG unit].
MIN_ERROR = 1e-3  # Smallest error of the plot [mm].
LABEL_HEIGHT = 11  # Distance of two labels, one above the other [SVG unit].
LABEL_WIDTH = 70  # Labels nearer than this side by side are parted [SVG unit].


def format_cost_plot(rows: Sequence[ComparisonRow]) -> str:
    """Return an SVG plot of error [mm] against time [ms] on logarithmic axes, with a caption; empty without rows."""
    if not rows:
        return ""
    if rows[0].is_optimal is not None:
        load_text = f"the same {_format_load_count(rows[0].loads)}; bold: no other is both faster and more accurate"
    else:
        load_text = "the loads up to now" if len(rows) == 1 else "different loads: not comparable"
    xs, x_ticks = _scale_axis([row.milliseconds for row in rows], LEFT, WIDTH - RIGHT)
    ys, y_ticks = _scale_axis([max(row.millimetres, MIN_ERROR) for row in rows], HEIGHT - BOTTOM, TOP)
    anchors = {x_ticks[-1][0]: "end"}  # the last label stays inside
    parts = [_draw_text(x, HEIGHT - BOTTOM + 12, f"{value:g}", anchors.get(value, "middle")) for value, x in x_ticks]
    parts += [_draw_text(LEFT - 5, at + 4, f"{value:g}", "end") for value, at in y_ticks]
    grid = [f"M{at:.0f} {TOP}V{HEIGHT - BOTTOM}" for _, at in x_ticks]
    grid += [f"M{LEFT} {at:.0f}H{WIDTH - RIGHT}" for _, at in y_ticks]
    placed: list[tuple[float, float]] = []
    for row, x, y in zip(rows, xs, ys, strict=True):
        label_y = y + 4.0
        while any(abs(label_y - v) < LABEL_HEIGHT and abs(x - u) < LABEL_WIDTH for u, v in placed):
            label_y += 2.0
        placed.append((x, label_y))
        is_right = x > 0.6 * WIDTH
        label = _draw_text(x + (-7 if is_right else 7), label_y, _format_name(row), "end" if is_right else "start")
        parts.append(
            f"<g{' class=best' if row.is_optimal else ''}><title>{escape(describe_cost_row(row))}</title>"
            f'<circle cx="{x:.0f}" cy="{y:.0f}" r="4"/>{label}</g>'
        )
    description = "; ".join(map(describe_cost_row, rows))
    return (
        f'<svg class="cost" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(description)}">'
        f'<path d="{"".join(grid)}"/>{"".join(parts)}{_draw_text(WIDTH - RIGHT, HEIGHT - 4, "time [ms]", "end")}'
        f"{_draw_text(2, HEIGHT - 4, 'error [mm]', 'start')}</svg>"
        f'<p class="dim">Mean error relative to FEM against time, medians over {load_text}.</p>'
    )


def describe_cost_row(row: ComparisonRow) -> str:
    """Describe the time and the error of one deformer in a line of text."""
    error = f"{row.millimetres:.3f}" if row.millimetres >= MIN_ERROR else f"under {MIN_ERROR:.3f}"
    return f"{_format_name(row)}: {row.milliseconds:.1f} ms, error {error} mm, {_format_load_count(row.loads)}"


def _format_name(row: ComparisonRow) -> str:
    return "FEM (reference)" if row.name == "fem" else row.name


def _scale_axis(values: Sequence[float], start: float, stop: float) -> tuple[list[float], list[tuple[float, float]]]:
    """Return positions of values on a logarithmic axis from `start` to `stop`, and pairs (power of ten, position)."""
    low, high = np.floor(np.log10(min(values))), np.ceil(np.log10(max(values)))
    span = max(high - low, 1.0)

    def locate(value: float) -> float:
        return float(start + (stop - start) * (np.log10(value) - low) / span)

    return [locate(x) for x in values], [(tick, locate(tick)) for tick in 10.0 ** np.arange(low, low + span + 0.5)]


def _draw_text(x: float, y: float, text: str, anchor: str) -> str:
    """Return an SVG text element at (x, y)."""
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}">{escape(text)}</text>'


def _format_load_count(loads: int) -> str:
    return f"{loads} load{'' if loads == 1 else 's'}"
