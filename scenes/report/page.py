"""The report as files: a page that needs nothing else, plots, a table for spreadsheets, and every number as JSON."""

import json
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from ar.screen import write_png
from sim.deformation import Outcome
from sim.runtime.atomic_files import write_atomically
from surrogate.model.held_out import MIN_LOADS_FOR_P999

from ..analysis.loglog_chart import draw_panels, draw_svg
from ..analysis.measurement import write_table
from .charts import CHARTS, find_front, format_number
from .row import ERROR, ErrorFigures, ReportRow

SETS = {  # Descriptions of the sets of test loads.
    "discs": "whole discs of cortex left out",
    "sectors": "whole sectors of direction left out",
    "beyond": "beyond the training range",
}
# Column titles of the table of error distributions.
SPREAD_HEADS = (
    "mean mm", "p95", "p99.9", "largest", "worst vertex mm: mean", "p95", "p99.9", "mean %", "p95", "p99.9", "largest",
)  # fmt: skip
# Style sheet of the page.
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1200px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; font-size: 13px; margin: 1em 0; }
th, td { padding: 3px 8px; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top; white-space: nowrap; }
th { background: #f4f4f4; } th:first-child, td:first-child { text-align: left; }
tr.front td:first-child { font-weight: bold; } tr.pale td { color: #777; } img { max-width: 100%; }
figure { display: inline-block; width: 370px; margin: 0 8px 12px 0; } figcaption { font-size: 13px; }
.wide { overflow-x: auto; }
figure.chart { width: 880px; max-width: 100%; } figure.chart svg { width: 100%; height: auto; }
summary { cursor: pointer; margin: 0.5em 0; }
"""
NOTES = (  # Paragraphs below the tables.
    "Two errors are given. The error relative to the reference is the accuracy of a row. The error relative to "
    "the FEM that it was trained on is the surrogate error. A row with another law than "
    "the reference's has a model difference instead of an error. The reference's own elements with a looser tolerance "
    "show only the error of that tolerance and are not plotted.",
    "Distances are taken over every load and vertex of the tumour; % is of each load's motion, the mean displacement "
    "of those vertices. A row in bold, or full colour, is Pareto-optimal in time and mean error.",
    "Worst vertex: of each load the vertex with the largest distance; mean, p95 and p99.9 are over the loads. "
    f"No p99.9 is given for fewer than {MIN_LOADS_FOR_P999:,} loads.",
    "Solves: all FEM solutions used by a row: loads, linear responses to unit forces at nodes of the "
    "cortex, and terms of the power series. In discs: those of the tumour under loads inside the held-out discs. "
    "The linear responses of the cortex are included in all; the cortex is not compared. Minutes: duration of "
    "these solves, on the machine that ran them, and of training.",
    "Time: one load at a time, from the undeformed state, trained models on one core; median; p99 of at least 1,000. "
    "It includes bound and limits; the time of the model alone is next to it. "
    "Set-up, compilation and warm-up are excluded. Memory: peak resident size of the process that built and "
    "ran the row; card: peak GPU memory.",
    "Bounds are guaranteed for loads distributed like the training loads. Their coverage in held-out discs, and "
    "outside the training range, is shown, but not guaranteed. The coverage in discs belongs to another model than "
    "the other numbers of the row, because some of the loads calibrate its bounds.",
    "Adapting: wall time until a result is available again after the central fifth of the tumour is removed. For "
    "FEM: set-up and the first load; for a trained model: new solves and training. In brackets: "
    "mean error after that [mm], on held-out discs, relative to FEM of the debulked body.",
)


@dataclass(frozen=True)
class Section:
    """The rows of one data set, and sentences about data and reference."""

    name: str
    about: tuple[str, ...]
    rows: tuple[ReportRow, ...]


def write_report(folder: Path, machine: str, sections: Sequence[Section]) -> None:
    """Write `index.html`, `report.json`, and for each section `NAME.csv` and its plots, each whole."""
    bodies = []
    for section in sections:
        plots = []
        for kind, build in CHARTS.items():
            chart = build(section.rows)
            if chart is not None:
                write_png(folder / f"{section.name}-{kind}.png", draw_panels([chart]))
                plots.append(f"<figure class=chart>{draw_svg(chart)}</figure>")
        write_table(folder / f"{section.name}.csv", [dict(_flatten(asdict(row))) for row in section.rows])
        bodies.append(_format_section(section, folder, plots))
    with write_atomically(folder / "report.json", ".json") as partial:
        partial.write_text(json.dumps({"machine": machine, "sections": [asdict(section) for section in sections]}))
    notes = "".join(f"<p>{escape(note)}</p>" for note in NOTES)
    with write_atomically(folder / "index.html", ".html") as partial:
        partial.write_text(
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>What accuracy costs in time</title>'
            f"<style>{STYLE}</style><h1>What accuracy costs in time</h1>{''.join(bodies)}<h2>How to read this</h2>"
            f"{notes}<p>{escape(machine)}. Research software, not a medical device.</p></html>\n"
        )


def _format_section(section: Section, folder: Path, plots: Sequence[str]) -> str:
    measured = [row for row in section.rows if row.reference is not None]
    learnt = [row for row in section.rows if row.own_fem]
    about = "".join(f"<p>{escape(sentence)}</p>" for sentence in section.about)
    pictures = [
        f"<figure>{_embed_image(folder / 'pictures' / row.picture, row.name)}"
        f"<figcaption>{escape(row.name)}</figcaption></figure>"
        for row in measured
        if row.picture
    ]
    return (
        f"<h2>{escape(section.name)}</h2>{''.join(plots)}{_format_summary(section.rows)}{about}"
        f"<details><summary>All numbers against the reference</summary>{_format_reference_table(section)}</details>"
        + (
            f"<details><summary>Learners against their own finite elements</summary>{_format_own_fem_table(learnt)}"
            "</details>"
            if learnt
            else ""
        )
        + "<h3>Worst cases</h3><p>The tumour as the row has it, and dashed in yellow where the reference has it; a "
        "pixel is about 0.1 mm.</p>"
        f"{''.join(pictures)}{_format_plans(measured)}"
    )


SUMMARY_HEADS = (
    "model", "kind", "mean error mm", "% of the motion", "median ms", "preparation s", "resection known after s",
    "memory GiB", "reliable loads",
)  # fmt: skip
"""Column titles of the table of models."""


def _format_summary(rows: Sequence[ReportRow]) -> str:
    """Return one line for each model: accuracy, time, preparation, adaptability, memory, outcomes."""
    best = find_front(rows)
    lines = []
    for row in rows:
        if row.reference is None or row.against != ERROR:
            continue
        reliable = sum(count for name, count in row.outcomes.items() if Outcome[name].good)
        costs = (row.median, row.preparation, row.adapt, row.memory)
        cells = (
            row.name, row.family, *map(format_number, (row.reference.mm.mean, row.reference.percent.mean, *costs)),
            f"{reliable} of {sum(row.outcomes.values())}" if row.outcomes else "",
        )  # fmt: skip
        lines.append(("front" if row.name in best else "", cells))
    return _format_table(SUMMARY_HEADS, lines) if lines else ""


def _format_plans(rows: Sequence[ReportRow]) -> str:
    """Describe how the FEM rows solve a load."""
    plans = []
    for row in rows:
        lines = "".join(f"<li>{escape(line)}" for line in row.plan)
        if lines:
            plans.append(f"<details><summary>{escape(row.name)}</summary><ul>{lines}</ul></details>")
    return f"<h3>Which solvers finite elements try</h3>{''.join(plans)}" if plans else ""


def _format_reference_table(section: Section) -> str:
    best = find_front(section.rows)
    heads = (
        "row", "distance", "loads", *SPREAD_HEADS, "median ms", "p99", "model in NumPy ms", "set-up s", "memory GiB",
        "card", "solves", "in discs", "minutes", "adapting s",
    )  # fmt: skip
    lines = []
    for row in section.rows:
        if row.state != "measured":
            lines.append(("pale", (row.name, row.state, *[""] * (len(heads) - 2))))
            continue
        minutes = None if row.learning is None else (row.learning + (row.solving or 0.0)) / 60.0
        short = "" if row.solving is not None or row.loads is None else " of fitting"
        cost = (row.median, row.p99, row.bare, row.set_up, row.memory, row.card)
        cells = (
            row.name, row.against, _count(row), *_spread(row.reference), *map(format_number, cost),
            _format_solves(row),
            "" if row.inside is None else str(row.inside), format_number(minutes) + short, _format_adaptation(row),
        )  # fmt: skip
        lines.append(("front" if row.name in best else "", cells))
    return _format_table(heads, lines)


def _format_adaptation(row: ReportRow) -> str:
    if row.adapt is None:
        return "not measured"
    return (
        format_number(row.adapt)
        if row.adapted is None
        else f"{format_number(row.adapt)} ({format_number(row.adapted.mm.mean)})"
    )


def _format_solves(row: ReportRow) -> str:
    """Format the number of FEM solves that a row used, by kind."""
    kinds = ((row.loads, ""), (row.units, " unit"), (row.series, " series"))
    return " + ".join(f"{count}{kind}" for count, kind in kinds if count)


def _count(row: ReportRow) -> str:
    loads = 0 if row.reference is None else row.reference.loads
    return f"{loads}, {row.failed} failed" if row.failed else str(loads)


def _format_own_fem_table(rows: Sequence[ReportRow]) -> str:
    heads = (
        "row", "loads of", "loads", *SPREAD_HEADS, "called extrapolated", "within 95 % bound",
    )  # fmt: skip
    return _format_table(
        heads,
        (
            (
                "",
                (
                    *(row.name, words, str(figures.loads), *_spread(figures)),
                    *(_share(shares.get(name)) for shares in (row.flagged, row.covered)),
                ),
            )
            for row in rows
            for name, words in SETS.items()
            if (figures := row.own_fem.get(name)) is not None
        ),
    )


def _share(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.0f} %"


def _spread(figures: ErrorFigures | None) -> tuple[str, ...]:
    if figures is None:
        return ("",) * len(SPREAD_HEADS)
    worst = figures.worst
    values = (*asdict(figures.mm).values(), worst.mean, worst.p95, worst.p999, *asdict(figures.percent).values())
    return tuple("\N{EN DASH}" if value is None else format_number(value) for value in values)


def _format_table(heads: Sequence[str], lines: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Lines of a class and cells."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(
        f'<tr class="{kind}">{"".join(f"<td>{escape(cell)}</td>" for cell in cells)}</tr>' for kind, cells in lines
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def _embed_image(path: Path, words: str) -> str:
    """Embed an image in the page."""
    data = b64encode(path.read_bytes()).decode()
    return f'<img alt="{escape(words)}" src="data:image/png;base64,{data}">'


def _flatten(value: Any, name: str = "") -> Iterable[tuple[str, Any]]:
    """Numbers and texts; one inside others is named by the way to it, as in reference.mm.mean."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else None
    if inside is None:
        yield name, value
        return
    for key, each in inside:
        yield from _flatten(each, f"{name}.{key}" if name else str(key))
