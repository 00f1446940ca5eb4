"""Credibility page: claims in the order of ASME V&V 40, with their figures from records, and their tests."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import wrap_errors

from .page import format_page, format_table

STEPS = (
    "context of use",
    "question of interest",
    "model risk",
    "verification",
    "validation",
    "uncertainty",
    "applicability",
)
"""Steps of ASME V&V 40-2018, "Assessing Credibility of Computational Modeling through Verification and Validation"."""
MISSING = "missing"  # Status of a claim that nothing supports.
STATUSES = ("supported", "refuted", "not independent", "not judged", MISSING)
HEADINGS = "claim", "status", "result", "fails if", "tests", "measured by"  # Columns of the page.
REMEDY = "Give the folder benchmarks of a checkout, with credibility.toml and records."
ABOUT = (
    "Numbers that have a command in the last column are read from the record of that measurement; tests run on each "
    "commit. Files are named relative to a checkout. Not judged: a definition, or a size without a limit. Not "
    f"independent: the evidence also set a parameter. {MISSING.capitalize()}: nothing supports the claim yet.",
    "This assesses the software for research. It is no clinical validation.",
)


@dataclass(frozen=True)
class CredibilityRow:
    """Claim of a step of V&V 40, its status, result and the condition under which it fails, its tests and records."""

    step: str
    claim: str
    status: str
    result: str
    fails_if: str
    tests: str
    records: str


def read_credibility(folder: Path) -> tuple[CredibilityRow, ...]:
    """Read the claims of `credibility.toml`, and fill each `#` of a result with a figure of `records`.

    Raises
    ------
    InputError
        A file or figure is missing, a field has another format, or a step is unknown or without a claim.
    """
    path = folder / "credibility.toml"
    with wrap_errors(path, "a list of claims", REMEDY):
        claims = tomllib.loads(path.read_text(encoding="utf-8"))["claim"]
        rows = tuple(_read_claim(claim, folder / "records") for claim in claims)
    if lacking := [step for step in STEPS if step not in {row.step for row in rows}]:
        raise InputError(f"{path} has no claim for {', '.join(lacking)}: each step needs one.")
    return tuple(sorted(rows, key=lambda row: STEPS.index(row.step)))


def _read_claim(claim: Mapping[str, Any], records: Path) -> CredibilityRow:
    figures = claim.get("figures", [])
    head, *parts = claim.get("result", "").split("#")
    usual = MISSING if "result" not in claim else "supported" if "fails_if" in claim else "not judged"
    status = claim.get("status", usual)
    if claim["step"] not in STEPS or status not in STATUSES or len(parts) != len(figures):
        raise InputError(
            f"{claim['claim']!r} has an unknown step or status, or another number of # than of figures. {REMEDY}"
        )
    origins: dict[str, None] = {}
    for figure, part in zip(figures, parts, strict=True):
        try:
            name, row, column = figure.split(" > ")
            record = json.loads((records / f"{name}.json").read_text(encoding="utf-8"))
            head += f"{record['figures'][row][column]}{part}"
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{figure!r} is not a figure of {records}: write RECORD > ROW > COLUMN.") from error
        origins[f"{record['command']}, {record['date']}; machine: {record['machine']}"] = None
    tests = "; ".join(str(test) for test in claim.get("tests", []))
    return CredibilityRow(
        claim["step"], claim["claim"], status, head, claim.get("fails_if", ""), tests, "; ".join(origins)
    )


def count_statuses(rows: Sequence[CredibilityRow]) -> dict[str, int]:
    """Count the claims of each status."""
    return {status: sum(row.status == status for row in rows) for status in STATUSES}


def write_credibility(folder: Path, rows: Sequence[CredibilityRow]) -> None:
    """Write the page `index.html` and the rows as `credibility.json`."""
    counts = ", ".join(f"{count} {status}" for status, count in count_statuses(rows).items())
    body = f"<p>{len(rows)} claims: {counts}.</p>"
    for step in STEPS:
        own = [row for row in rows if row.step == step]
        cells = [(row.claim, row.status, row.result, row.fails_if, row.tests, row.records) for row in own]
        used = [column for column in range(len(HEADINGS)) if any(row[column] for row in cells)]
        lines = [(f"text {row.status}", [each[k] for k in used]) for row, each in zip(own, cells, strict=True)]
        table = format_table([HEADINGS[k] for k in used], lines)
        body += f"<h2>{escape(step.capitalize())}</h2>{table}"
    with write_atomically(folder / "credibility.json", ".json") as partial:
        partial.write_text(json.dumps([asdict(row) for row in rows]))
    with write_atomically(folder / "index.html", ".html") as partial:
        partial.write_text(format_page("Credibility in the order of ASME V&V 40", body, ABOUT))
