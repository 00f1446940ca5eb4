"""Charts of the last seconds: values over time as lines, each with its error as a band."""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape

TIME_SPAN = 20.0
"""Time span of a chart [s]."""
CHART_WIDTH = 600.0  # Width of the charts [SVG units].
CHART_HEIGHT = 105.0  # Height of one chart [SVG units].
LEFT_MARGIN = 44.0  # Left margin of a chart [SVG units].
TOP_MARGIN = 20.0  # Margin above the curve of a chart [SVG units].
BOTTOM_MARGIN = 16.0  # Margin below the curve of a chart [SVG units].
MAX_SAMPLES = 1200  # Maximum number of samples that are kept.
MAX_DRAWN_SAMPLES = 240  # Maximum number of samples that are drawn, one or two pixels apart.
MAX_TIME_GAP = 2.0  # Time gap beyond which samples are not joined [s].
HALF_DOT_WIDTH = 0.06  # Half the width of an isolated sample [s].


@dataclass(frozen=True)
class Trace:
    """Line of a chart: name, unit, colour, and name of the source of its error."""

    name: str
    unit: str
    colour: str
    error_source: str = ""


@dataclass(frozen=True)
class Sample:
    """Sample at a time [s]: value and error of each line, in the line's unit; None where not available."""

    time: float
    values: tuple[float | None, ...]
    errors: tuple[float | None, ...]


@dataclass
class History:
    """Recent samples of several lines; samples more than `TIME_SPAN` older than the newest are dropped."""

    lines: tuple[Trace, ...]
    samples: deque[Sample] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))

    def add(self, sample: Sample) -> None:
        """Add a sample, and drop samples more than `TIME_SPAN` older."""
        self.samples.append(sample)
        while self.samples[0].time < sample.time - TIME_SPAN:
            self.samples.popleft()

    def interrupt_lines(self, time: float) -> None:
        """Interrupt all lines at a time [s], by a sample without values."""
        unknown = (None,) * len(self.lines)
        self.add(Sample(time, unknown, unknown))

    def draw_chart(self) -> str:
        """Draw the charts of all lines, one below the other, as an SVG element."""
        kept = list(self.samples)
        step = max(1, math.ceil(len(kept) / MAX_DRAWN_SAMPLES))
        gaps = [None in each.values for each in kept]
        kept = [each for place, each in enumerate(kept[:-1]) if place % step == 0 or gaps[place]] + kept[-1:]
        parts = [_draw_trace(line, number, kept) for number, line in enumerate(self.lines)]
        words = "; ".join(f"{line.name}: {_format_newest(kept, number)}" for number, line in enumerate(self.lines))
        size = f"0 0 {CHART_WIDTH:g} {CHART_HEIGHT * len(self.lines):g}"
        return (
            f'<svg viewBox="{size}" role="img" aria-label="{escape(f"The last {TIME_SPAN:g} seconds. {words}")}">'
            f"{''.join(parts)}</svg>"
        )


def _format_newest(samples: Sequence[Sample], trace_index: int) -> str:
    value = samples[-1].values[trace_index] if samples else None
    return "not known" if value is None else f"{value:.2f}"


def _draw_trace(trace: Trace, index: int, samples: Sequence[Sample]) -> str:
    """Draw the chart of one line: dotted without an error, interrupted without a value."""
    known = [each for each in samples if each.values[index] is not None]
    top, end = CHART_HEIGHT * index + TOP_MARGIN, samples[-1].time if samples else 0.0
    room = CHART_HEIGHT - TOP_MARGIN - BOTTOM_MARGIN
    ends = [(each.values[index] or 0.0, each.errors[index] or 0.0) for each in known]
    high = round_up_scale(max((value + error for value, error in ends), default=0.0))

    def to_text(time: float, value: float) -> str:
        across = LEFT_MARGIN + (CHART_WIDTH - LEFT_MARGIN - 6.0) * (1.0 - (end - time) / TIME_SPAN)
        return f"{across:.1f},{top + room * (1.0 - min(max(value / high, 0.0), 1.0)):.1f}"

    drawn = []
    for piece in split_line(samples, index):
        # An isolated sample is as wide as its dot.
        moments = [
            (each.time + aside, each)
            for each in piece
            for aside in ((0.0,) if len(piece) > 1 else (-HALF_DOT_WIDTH, HALF_DOT_WIDTH))
        ]
        if piece[-1].errors[index] is not None:
            above = [to_text(time, (each.values[index] or 0.0) + (each.errors[index] or 0.0)) for time, each in moments]
            below = [to_text(time, (each.values[index] or 0.0) - (each.errors[index] or 0.0)) for time, each in moments]
            corners = " ".join([*above, *reversed(below)])
            drawn.append(f'<polygon points="{corners}" fill="{trace.colour}" fill-opacity="0.28"/>')
        dotted = ' stroke-dasharray="2 3"' if piece[-1].errors[index] is None else ""
        corners = " ".join(to_text(time, each.values[index] or 0.0) for time, each in moments)
        drawn.append(f'<polyline points="{corners}" fill="none" stroke="{trace.colour}" stroke-width="1.6"{dotted}/>')
    if not known:
        middle = f'x="{0.5 * (LEFT_MARGIN + CHART_WIDTH):g}" y="{top + 0.5 * room + 4:g}"'
        what = "not known" if samples else "nothing yet"
        drawn.append(f'<text {middle} text-anchor="middle" opacity="0.7">{what}</text>')
    said = f"{trace.name} [{trace.unit}]" + (f", {trace.error_source}" if trace.error_source else "")
    scale = "".join(
        f'<text x="{LEFT_MARGIN - 5:g}" y="{top + room * (1 - share) + 4:g}" text-anchor="end">{share * high:g}</text>'
        f'<path d="M{LEFT_MARGIN:g} {top + room * (1 - share):g}H{CHART_WIDTH - 6:g}" '
        'stroke="#666" stroke-width="0.6"/>'
        for share in (0.0, 1.0)
    )
    times = "".join(
        f'<text x="{LEFT_MARGIN + (CHART_WIDTH - LEFT_MARGIN - 6) * share:g}" y="{top + room + 14:g}" '
        f'text-anchor="{anchor}">{words}</text>'
        for share, anchor, words in (
            (0.0, "start", f"{TIME_SPAN:g} s ago"),
            (0.5, "middle", "10 s"),
            (1.0, "end", "now"),
        )
    )
    return f'<text x="{LEFT_MARGIN:g}" y="{top - 6:g}">{escape(said)}</text>{scale}{times}{"".join(drawn)}'


def split_line(samples: Iterable[Sample], line_index: int) -> list[list[Sample]]:
    """Split a line into pieces of successive samples, each completely with or completely without an error.

    A piece ends where the value is not available, or at a time gap.
    """
    found: list[list[Sample]] = []
    last: Sample | None = None
    for each in samples:
        before, last = last, each if each.values[line_index] is not None else None
        if last is None:
            continue
        if before is not None and each.time - before.time < MAX_TIME_GAP:
            if (before.errors[line_index] is None) == (each.errors[line_index] is None):
                found[-1].append(each)
                continue
            found.append([before, each] if each.errors[line_index] is None else [each])
            continue
        found.append([each])
    return found


def round_up_scale(value: float) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that is not below a value, as the end of a scale."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(power * step for step in (1.0, 2.0, 5.0, 10.0) if power * step >= value * (1.0 - 1e-9))
