"""Files of the report: a self-contained HTML page, plots, tables (CSV), and all numbers as JSON."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from ar.screen import write_png
from sim.deformation import Outcome
from sim.runtime.atomic_files import write_atomically

from ..analysis.loglog_chart import draw_panels, draw_svg
from ..analysis.measurement import write_table
from ..play.effect_record import EffectRecord
from .charts import CHARTS, build_effects_chart, find_front, format_number
from .row import ERROR, ReportRow

# Style sheet of the page.
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1200px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; font-size: 13px; margin: 1em 0; }
th, td { padding: 3px 8px; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top; white-space: nowrap; }
th { background: #f4f4f4; } th:first-child, td:first-child { text-align: left; }
tr.front td:first-child { font-weight: bold; }
tr.text td { text-align: left; white-space: normal; overflow-wrap: anywhere; }
table:has(tr.text) { table-layout: fixed; width: 100%; } table:has(tr.text) th { text-align: left; }
table:has(tr.text) th:first-child { width: 30%; } table:has(tr.text) th:nth-child(2) { width: 9%; }
tr.missing td { background: #fff0d8; } tr.refuted td { background: #fde0dc; }
@media (max-width: 700px) {
  table:has(tr.text) th { display: none; } tr.text { border-bottom: 2px solid #888; }
  tr.text td { display: block; border: 0; } tr.text td:empty { display: none; }
  tr.text td + td::before { content: attr(title) ": "; color: #666; }
}
.wide { overflow-x: auto; }
figure.chart { width: 880px; max-width: 100%; margin: 0 0 12px; } figure.chart svg { width: 100%; height: auto; }
"""
NOTES = (  # Paragraphs below the tables.
    "Error: mean distance from the reference over all compared loads and vertices of the tumour, and in % of each "
    "load's motion; bars in the charts are the central 95 % of the loads. A bold row, or full colour, is "
    "Pareto-optimal in time and error. Another law than the reference's is a model difference, not an error; the "
    "reference's own elements with another tolerance show the error of that tolerance alone, and are in no chart.",
    "Time: one load at a time, from the undeformed state, until the result with its bound; trained models on one core. "
    "Preparation: set-up with compiled kernels, or simulation and training. Resection: time until the first load after "
    "the central fifth of the tumour is removed; for a trained model new simulations and training.",
    "Tool moved: every model gets the mean motion of the tool's footprint in the reference, and finds its own force; "
    "the stiffness of the whole body then does not matter. Not measured with --quick.",
    "Reliable loads: those whose outcome is reliable by the model itself. Geometry-based models never are. Bounds of "
    "trained models hold for loads distributed like the training loads. Their measured coverage, there and beyond, "
    "and distances from their own finite elements are in the CSV and JSON files, with all other numbers.",
)


@dataclass(frozen=True)
class Section:
    """Section of the report for one data set: rows, sentences about data and reference, and effect records."""

    name: str
    about: tuple[str, ...]
    rows: tuple[ReportRow, ...]
    anatomy: str = ""
    tissue: str = ""
    effects: tuple[EffectRecord, ...] = ()


def write_report(folder: Path, machine: str, sections: Sequence[Section]) -> None:
    """Write `index.html`, `report.json`, and for each section `NAME.csv` and plots, each file atomically."""
    bodies = []
    for section in sections:
        plots = []
        charts = {kind: build(section.rows) for kind, build in CHARTS.items()}
        for kind, chart in {**charts, "effects": build_effects_chart(section.effects)}.items():
            if chart is not None:
                write_png(folder / f"{section.name}-{kind}.png", draw_panels([chart]))
                plots.append(f"<figure class=chart>{draw_svg(chart)}</figure>")
        write_table(folder / f"{section.name}.csv", [dict(_flatten(asdict(row))) for row in section.rows])
        bodies.append(_format_section(section, plots))
    with write_atomically(folder / "report.json", ".json") as partial:
        partial.write_text(json.dumps({"machine": machine, "sections": [asdict(section) for section in sections]}))
    with write_atomically(folder / "index.html", ".html") as partial:
        partial.write_text(format_page("What accuracy costs in time", "".join(bodies), (*NOTES, f"{machine}.")))


def format_page(title: str, body: str, notes: Sequence[str]) -> str:
    """Format a self-contained HTML page: title, body (HTML), and paragraphs of plain text on how to read it."""
    paragraphs = "".join(f"<p>{escape(note)}</p>" for note in (*notes, "Research software, not a medical device."))
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
        f"<h1>{title}</h1>{body}<h2>How to read this</h2>{paragraphs}</html>\n"
    )


def _format_section(section: Section, plots: Sequence[str]) -> str:
    about = "".join(f"<p>{escape(sentence)}</p>" for sentence in section.about)
    missing = "".join(
        f"<p>{escape(row.name)}: {escape(row.state)}</p>" for row in section.rows if row.reference is None
    )
    return f"<h2>{escape(section.name)}</h2>{''.join(plots)}{_format_summary(section.rows)}{missing}{about}"


SUMMARY_HEADS = (
    "model", "kind", "mean error mm", "% of the motion", "% if the tool is moved", "median ms", "preparation s",
    "resection known after s", "memory GiB", "reliable loads",
)  # fmt: skip
"""Column titles of the table of models."""


def _format_summary(rows: Sequence[ReportRow]) -> str:
    """Format the summary table (HTML): errors, times, memory and outcomes of each model; empty without rows."""
    best = find_front(rows)
    lines = []
    for row in rows:
        if row.reference is None or row.against != ERROR:
            continue
        reliable = sum(count for name, count in row.outcomes.items() if Outcome[name].good)
        costs = (row.pose and row.pose.percent.mean, row.median, row.preparation, row.adapt, row.memory)
        cells = (
            row.name, row.family, *map(format_number, (row.reference.mm.mean, row.reference.percent.mean, *costs)),
            f"{reliable} of {sum(row.outcomes.values())}" if row.outcomes else "",
        )  # fmt: skip
        lines.append(("front" if row.name in best else "", cells))
    return format_table(SUMMARY_HEADS, lines) if lines else ""


def format_table(headings: Sequence[str], lines: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Format an HTML table from column titles and lines, each a CSS class and its cells."""
    head = "".join(f"<th>{escape(text)}</th>" for text in headings)
    body = "".join(
        f'<tr class="{kind}">'
        + "".join(
            f'<td title="{escape(title)}">{escape(cell)}</td>' for title, cell in zip(headings, cells, strict=True)
        )
        + "</tr>"
        for kind, cells in lines
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def _flatten(value: Any, name: str = "") -> Iterable[tuple[str, Any]]:
    """Yield the values in nested dicts and lists with dotted names, such as reference.mm.mean."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else None
    if inside is None:
        yield name, value
        return
    for key, each in inside:
        yield from _flatten(each, f"{name}.{key}" if name else str(key))
