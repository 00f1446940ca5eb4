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
MISSING = "missing"  # Result of a claim that nothing supports.
REMEDY = "Give the folder benchmarks of a checkout, with credibility.toml and records."
ABOUT = (
    "Each result is read from a record of a measurement, whose command, machine and date stand with it. Tests run on "
    f'each commit. "{MISSING}": nothing supports the claim yet.',
    "This assesses the software for research. It is no clinical validation.",
)


@dataclass(frozen=True)
class CredibilityRow:
    """Claim of a step of V&V 40, its result, what would refute it, and where it is measured and tested."""

    step: str
    claim: str
    result: str
    refuted: str
    sources: str


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
    head, *parts = claim.get("result", MISSING).split("#")
    if claim["step"] not in STEPS or len(parts) != len(figures):
        raise InputError(f"{claim['claim']!r} has an unknown step, or another number of # than of figures. {REMEDY}")
    origins: dict[str, None] = {}
    for figure, part in zip(figures, parts, strict=True):
        try:
            name, row, column = figure.split(" > ")
            record = json.loads((records / f"{name}.json").read_text(encoding="utf-8"))
            head += f"{record['figures'][row][column]}{part}"
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{figure!r} is not a figure of {records}: write RECORD > ROW > COLUMN.") from error
        origins[f"{record['command']} ({record['machine']}, {record['date']})"] = None
    tests = [str(test) for test in claim.get("tests", [])]
    return CredibilityRow(claim["step"], claim["claim"], head, claim.get("refuted", ""), "; ".join([*tests, *origins]))


def write_credibility(folder: Path, rows: Sequence[CredibilityRow]) -> None:
    """Write the page `index.html` and the rows as `credibility.json`."""
    body = ""
    for step in STEPS:
        own = [row for row in rows if row.step == step]
        kinds = ["text missing" if row.result == MISSING else "text" for row in own]
        lines = zip(kinds, [(row.claim, row.result, row.refuted, row.sources) for row in own], strict=True)
        table = format_table(("claim", "result", "refuted by", "tests and records"), lines)
        body += f"<h2>{escape(step.capitalize())}</h2>{table}"
    with write_atomically(folder / "credibility.json", ".json") as partial:
        partial.write_text(json.dumps([asdict(row) for row in rows]))
    with write_atomically(folder / "index.html", ".html") as partial:
        partial.write_text(format_page("Credibility in the order of ASME V&V 40", body, ABOUT))
