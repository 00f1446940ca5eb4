"""Measured figures of README and the user pages: each equals its record, and occurs on one page.

Records are `benchmarks/records/*.json` and `benchmarks/cards.json`; tests/data/figures.toml says which figure is whose.
"""

import hashlib
import json
import re
import tomllib
from collections import Counter
from itertools import chain
from pathlib import Path

import pytest

from scenes.play.deformers import to_model_path
from scenes.script.shipped_files import get_template_path

HOUSE = Path(__file__).parents[1]
FILES = {path.stem: json.loads(path.read_text()) for path in (HOUSE / "benchmarks/records").glob("*.json")}
RECORDS = {name: file["figures"] for name, file in FILES.items()}
RECORDS["cards"] = {
    row["name"]: {one["name"]: one["value"] for one in row["values"]}
    for row in json.loads((HOUSE / "benchmarks/cards.json").read_text())["rows"]
}
LISTED = tomllib.loads((HOUSE / "tests/data/figures.toml").read_text())
NUMBER = r"[+-]?\d+(?:,\d{3})*(?:\.\d+)?"
PAGES = sorted({*LISTED["tables"], *(one["page"] for one in LISTED["sentences"])})


def clean(row):
    """Cells of a row of a table, without marks."""
    return [re.sub(r"[`*]", "", cell).strip() for cell in re.split(r"(?<!\\)\|", row.strip()[1:-1])]


def read_tables(text):
    """Header and rows of each table."""
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        header, _, *rows = map(clean, block.splitlines())
        yield header, rows


def starts_with_keys(header, columns):
    """Return True if a header has columns of a record, and no other behind the first of these."""
    own = [name in columns for name in header]
    return any(own) and all(own[own.index(True) :])


def find_figures(page, text):
    """Figures of a page: (place in the records, text, digits or None)."""
    for record in LISTED["tables"].get(page, []):
        columns = set(chain.from_iterable(RECORDS[record].values()))
        tables = [table for table in read_tables(text) if starts_with_keys(table[0], columns)]
        assert tables, f"{page} has no table of {record}"
        for header, rows in tables:
            for cells in rows:
                row = ", ".join(cell for name, cell in zip(header, cells, strict=True) if name not in columns)
                for name, cell in zip(header, cells, strict=True):
                    if name in columns:
                        yield f"{record} > {row} > {name}", cell, None
    for sentence in LISTED["sentences"]:
        if sentence["page"] == page:
            pattern = r"\s+".join(map(re.escape, sentence["text"].split())).replace(r"\#", f"({NUMBER})")
            found = list(re.finditer(pattern, text))
            assert len(found) == 1, f"{page}: {sentence['text']}"
            for place, group in zip(sentence["figures"], found[0].groups(), strict=True):
                yield place, group, sentence.get("digits")


def agrees(text, value, digits):
    """Return True if a text shows a value of a record, rounded to the text's decimals."""
    if isinstance(value, str):
        return text == value
    shown = len(text.partition(".")[2]) if digits is None else digits
    return float(text.replace(",", "")) == round(float(value), shown)


def look_up(place):
    record, row, column = place.split(" > ")
    return RECORDS[record][row][column]


@pytest.fixture(scope="module")
def figures():
    """Figures of each page."""
    return {page: list(find_figures(page, (HOUSE / page).read_text())) for page in PAGES}


@pytest.mark.parametrize("page", PAGES)
def test_page_figures_agree_with_their_records(page, figures):
    assert not [(place, text) for place, text, digits in figures[page] if not agrees(text, look_up(place), digits)]


def test_changed_digit_in_a_figure_is_detected(figures):
    """In the text, or in the record by a unit of the last place that the text shows."""
    for place, text, digits in chain.from_iterable(figures.values()):
        value = look_up(place)
        at = [number for number, sign in enumerate(text) if sign.isdigit()]
        for number in at:
            other = f"{text[:number]}{(int(text[number]) + 1) % 10}{text[number + 1 :]}"
            assert not agrees(other, value, digits), (place, other)
        if not isinstance(value, str):
            shown = len(text.partition(".")[2]) if digits is None else digits
            assert not agrees(text, value + 10.0**-shown, digits), place


def test_figure_occurs_on_one_page(figures):
    """README repeats some of docs/accuracy.md."""
    count = Counter(place for page, found in figures.items() if page != "README.md" for place, *_ in found)
    assert not [place for place, number in count.items() if number > 1]


def test_every_number_of_the_summaries_has_a_record(figures):
    for page, head in (("README.md", "value"), ("docs/accuracy.md", None)):
        shown = {text for _, text, _ in figures[page]}
        for header, rows in read_tables((HOUSE / page).read_text()):
            if head in (None, header[-1]):
                cells = {cell for row in rows for cell in row[1:]} - shown
                assert {number for cell in cells for number in re.findall(NUMBER, cell)} <= shown


def test_record_states_its_origin(figures):
    for name, file in FILES.items():
        assert set(file) == {"command", "machine", "date", "figures"}, name
        assert file["command"] and file["machine"] and re.fullmatch(r"\d{4}-\d\d-\d\d", file["date"]), name
    listed = {place.partition(" > ")[0] for found in figures.values() for place, *_ in found}
    assert listed == set(RECORDS)


def test_chart_of_families_was_drawn_with_shipped_models():
    """Draw docs/report.png again with new models, and write their hash below the table."""
    digest = hashlib.sha256(to_model_path(get_template_path()).read_bytes()).hexdigest()[:12]
    assert digest in (HOUSE / "docs/notes/families.md").read_text()
