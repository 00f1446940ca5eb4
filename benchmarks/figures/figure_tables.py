"""Markdown tables of figures, printed or written between two marks of a page."""

import re
from collections.abc import Sequence
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import wrap_errors

from .figure_record import Entry, Record
from .figures import NAMED, format_command

BEGIN, END = "<!-- bench:", "<!-- end -->"
MARKED = re.compile(rf"({BEGIN} ([^\n]*?) -->\n)(.*?)({END})", re.DOTALL)
HEAD = "| figure | measured | command |\n|---|---|---|"
PLACES = "| measured on | figures |\n|---|---|"
NOT_HERE = "not measured here"


def format_number(value: float) -> str:
    """Format a number with three digits; from 100 on, as a whole number with separated thousands."""
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"


def format_table(entries: Sequence[Entry]) -> str:
    """Format a row for each figure, its numbers or a reason; below the table, machines and dates."""
    lines = [_line(it.name, _numbers(it) or f"{it.state}: {it.reason}", it.command) for it in entries]
    return _with_origins(lines, [it for it in entries if it.values])


def _with_origins(lines: Sequence[str], entries: Sequence[Entry]) -> str:
    places: dict[str, list[str]] = {}
    for entry in entries:
        places.setdefault(f"{entry.origin.machine}; {entry.origin.date}", []).append(f"`{entry.name}`")
    said = [f"Measured on {place}." for place in places]
    if len(places) > 1:
        said = ["\n".join((PLACES, *(f"| {place} | {', '.join(some)} |" for place, some in places.items())))]
    return "\n\n".join(("\n".join((HEAD, *lines)), *said))


def _line(name: str, cell: str, command: str) -> str:
    return f"| `{name}` | {cell.replace('|', '&#124;')} | `{command}` |"


def _numbers(entry: Entry) -> str:
    said = "; ".join(f"{one.name} {format_number(one.value)} {one.unit}" for one in entry.values)
    return f"{said} ({entry.reason})" if said and entry.reason else said


def read_page(path: Path) -> str:
    """Read the text of a page that has marks.

    Raises
    ------
    InputError
        A page without marks, with a mark that has no end, or with unknown figures.
    """
    with wrap_errors(path, "a page in Markdown", "Give a page of the documentation, such as docs/notes/figures.md."):
        text = path.read_bytes().decode()
        if path.suffix != ".md":
            raise InputError("is no page in Markdown: give a name that ends in .md.")
        blocks = MARKED.findall(text)
        if not blocks or len(blocks) != text.count(BEGIN):
            raise InputError(f"has no `{BEGIN} NAME ... -->` with an `{END}` for each: put these round the table.")
        asked = [name for block in blocks for name in block[1].split()]
        if wrong := [name for name in asked if name not in NAMED]:
            raise InputError(f"asks for {wrong[0]!r}, which is no figure: choose from {', '.join(NAMED)}.")
        return text


def write_page(path: Path, record: Record) -> bool:
    """Update the tables of a page; return True if the page changed.

    Raises
    ------
    InputError
        See `read_page`; a page that cannot be written.
    """
    before = read_page(path)
    after = MARKED.sub(lambda block: f"{block[1]}\n{_marked(block[2].split(), record)}\n\n{block[4]}", before)
    if after != before:
        with write_atomically(path, ".md") as partial:
            partial.write_bytes(after.encode())
    return after != before


def _marked(names: Sequence[str], record: Record) -> str:
    """Format the table of some figures, measured or not."""
    known = {entry.name: entry for entry in record.rows if entry.values}
    there = {name: known[name] for name in names if name in known}
    lines = [
        _line(name, _numbers(there[name]), there[name].command)
        if name in there
        else _line(name, NOT_HERE, format_command(NAMED[name]))
        for name in names
    ]
    return _with_origins(lines, list(there.values()))
