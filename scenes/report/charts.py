"""Charts of the report; the title of each chart is a question."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from surrogate.evaluation.choose import find_pareto_front

from ..analysis.loglog_chart import ChartPanel, Curve, Dot
from ..play.effect_record import EffectRecord
from .finite_elements import GEOMETRY, MECHANICS, SPRINGS
from .row import ERROR, TOLERANCE_ALONE, ErrorFigures, ReportRow

SIZE = (880, 560)  # Width and height of a chart [pixel].
DIFFERENT_LAW = "another law: model difference"  # Name of the group of rows with another material law.
GROUPS = ("finite elements", DIFFERENT_LAW, GEOMETRY, SPRINGS, MECHANICS, "trained models")  # One colour for each.
ERROR_LABEL = "mean distance from the reference at the tumour [mm]"  # Label of the error axes.
MARKS = ((60.0, "1 minute"), (600.0, "10 minutes"), (3600.0, "1 hour"))  # Times on the axes of preparation [s].
Place = tuple[float, float]


def find_front(rows: Sequence[ReportRow]) -> frozenset[str]:
    """Return the names of the rows on the Pareto front of time per load and mean distance from the reference.

    Rows with another material law, or with the reference's elements, are excluded: their distance is no model error.
    """
    return find_pareto_front({row.name: place for row in rows if row.against == ERROR and (place := _place_time(row))})


def _place_time(row: ReportRow) -> Place | None:
    return _place(row.median, row.reference)


def _place(x: float | None, figures: ErrorFigures | None) -> Place | None:
    """Return x and the mean distance [mm]; None unless both are positive, as logarithmic axes require."""
    return None if not x or figures is None or not figures.mm.mean > 0.0 else (x, figures.mm.mean)


def build_error_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of error against time per load, with bars for the central 95 % of the loads; None without rows.

    Rows that differ from the reference only by their solver tolerance are omitted, because their errors are tiny.
    """
    return _scatter(rows, "Which model is most accurate in the time available?", "milliseconds a load", _place_time)


def build_batch_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of error against time per load if all loads are solved in one batch; None without rows."""
    title = "And in a batch, as for training data or uncertainty?"
    return _scatter(rows, title, "milliseconds a load, all together", lambda row: _place(row.batch_ms, row.reference))


def build_effects_chart(records: Sequence[EffectRecord]) -> ChartPanel | None:
    """Build the chart of added time and added tumour motion of each recorded effect; None without records."""
    dots = tuple(
        Dot(f"{name}, {record.scene}", name, ms, mm, hint=f"{record.scene}, {record.day}, {record.machine}")
        for record in records
        for name, (ms, mm) in record.effects.items()
        if name != "all" and ms is not None and mm is not None and min(ms, mm) > 0.0
    )
    title = "What does an effect cost, and what does it change?"
    y = "the tumour moves by [mm]"
    return ChartPanel(title, "milliseconds a frame that it adds", y, dots=dots, size=SIZE) if dots else None


def build_preparation_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of error against the time before the first load; None without rows."""
    title = "How accurate is a model of a new patient after this time?"
    chart = _scatter(rows, title, "seconds before the first load", lambda row: _place(row.preparation, row.reference))
    return chart and replace(chart, marks=MARKS)


def build_adaptation_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of error against the time that a model needs to adapt to a resection; None without rows."""
    title = "How long until a model knows that tissue was removed?"
    return _scatter(rows, title, "seconds until the first load", lambda row: _place(row.adapt, row.reference))


def build_cortex_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of the error at the open cortex against time per load; None without rows."""

    def place(row: ReportRow) -> Place | None:
        mean = float(np.mean(row.cortex_mm)) if row.cortex_mm else 0.0
        return (row.median, mean) if row.median and mean > 0.0 else None

    title = "And at the open cortex, that the camera sees?"
    chart = _scatter(rows, title, "milliseconds a load", place, attrgetter("cortex_mm"))
    return chart and replace(chart, y="mean distance from the reference at the open cortex [mm]")


def build_pose_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of error against time if the tool's motion is prescribed, not its force; None without rows."""
    title = "And if the motion of the tool is known, not its force?"
    return _scatter(rows, title, "milliseconds a load", lambda row: _place(row.median, row.pose), lambda row: ())


def build_force_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of error against force, for the rows on the Pareto front; None without rows."""
    best, curves = find_front(rows), []
    for row in rows:
        if row.name in best and row.reference:
            tenths = ((0.5 * (tenth.least + tenth.greatest), tenth.percent) for tenth in row.reference.tenths)
            curves.append(Curve(row.name, tuple(place for place in tenths if min(place) > 0.0)))
    title = "Small and surgical forces: error of the models on the front"
    return (
        ChartPanel(title, "force [N]", "mean distance in % of the motion", tuple(curves), size=SIZE) if curves else None
    )


def build_learning_chart(rows: Sequence[ReportRow]) -> ChartPanel | None:
    """Build the chart of a trained model's error against the number of training loads; None without trained models."""
    curves = tuple(
        Curve(row.name, tuple((float(count), each.mm.mean) for count, each in row.curve)) for row in rows if row.curve
    )
    y = "mean distance from its own finite elements on held-out discs [mm]"
    title = "How many simulated loads does a learner require?"
    return ChartPanel(title, "training loads", y, curves, size=SIZE) if curves else None


def _scatter(
    rows: Sequence[ReportRow],
    title: str,
    x: str,
    find_point: Callable[[ReportRow], Place | None],
    get_errors: Callable[[ReportRow], Sequence[float]] = attrgetter("load_mm"),
) -> ChartPanel | None:
    """Build a scatter chart of rows at the positions that `find_point` returns; None if there is no position.

    The Pareto front is drawn; other rows are pale. Bars are the central 95 % of the load errors [mm] of `get_errors`.
    """
    places = {row.name: place for row in rows if row.against != TOLERANCE_ALONE and (place := find_point(row))}
    best = find_pareto_front(
        {row.name: places[row.name] for row in rows if row.name in places and row.against == ERROR}
    )
    dots = tuple(
        Dot(
            row.name,
            row.family if row.against == ERROR else DIFFERENT_LAW,
            *places[row.name],
            is_pale=row.name not in best,
            y_range=_find_central_range(get_errors(row)),
            hint=_describe_row(row),
        )
        for row in rows
        if row.name in places
    )
    front = tuple(places[name] for name in best)
    return ChartPanel(title, x, ERROR_LABEL, dots=dots, size=SIZE, front=front, groups=GROUPS) if dots else None


def _find_central_range(load_mm: Sequence[float]) -> tuple[float, float] | None:
    """Return the central 95 % range of the loads' errors [mm]; None if a logarithmic axis cannot show the range."""
    low, high = np.percentile(load_mm, [2.5, 97.5]).tolist() if load_mm else (0.0, 0.0)
    return (low, high) if low > 0.0 else None


def _describe_row(row: ReportRow) -> str:
    """Describe a row in one line: errors, times and command."""
    assert row.reference is not None
    error = f"mean {format_number(row.reference.mm.mean)} mm ({format_number(row.reference.percent.mean)} %)"
    loads = (
        f", median of {len(row.load_mm)} loads {format_number(float(np.median(row.load_mm)))} mm" if row.load_mm else ""
    )
    parts = (("", "ms", row.median), ("preparation ", "s", row.preparation), ("resection known after ", "s", row.adapt))
    times = "; ".join(f"{name}{format_number(value)} {unit}" for name, unit, value in parts if value is not None)
    return f"{row.name}, {row.family}: {error}{loads}; {times}{row.command and f'; {row.command}'}"


# Functions that build the charts, by name.
CHARTS = {
    "time": build_error_chart,
    "batch": build_batch_chart,
    "preparation": build_preparation_chart,
    "adaptation": build_adaptation_chart,
    "force": build_force_chart,
    "cortex": build_cortex_chart,
    "pose": build_pose_chart,
    "learning": build_learning_chart,
}


def format_number(value: float | None) -> str:
    """Format a number with three significant digits; None: an empty string."""
    if value is None:
        return ""
    return "< 0.0001" if 0.0 < value < 1e-4 else f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
