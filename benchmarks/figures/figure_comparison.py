"""Comparison of two records of figures: numbers that got worse."""

import math
from dataclasses import dataclass

from sim.errors import InputError

from .figure_record import Entry, Record, Value
from .figure_tables import format_number

MARGIN = 1.1
"""Factor above which a number counts as worse."""


@dataclass(frozen=True)
class Change:
    """Change of a number that both records contain."""

    name: str
    old: Value
    new: Value

    @property
    def ratio(self) -> float:
        """Ratio of the new number to the old one."""
        if self.old.value == self.new.value:
            return 1.0
        return self.new.value / self.old.value if self.old.value else math.inf

    @property
    def is_worse(self) -> bool:
        """True if the new number is worse by more than the margin."""
        grown, shrunk = self.ratio > MARGIN, self.ratio < 1.0 / MARGIN
        return {"smaller": grown, "larger": shrunk, "same": grown or shrunk}[self.new.better]

    @property
    def table_row(self) -> str:
        """Row of the Markdown table."""
        numbers = " | ".join(format_number(one.value) for one in (self.old, self.new))
        ratio = f"**{self.ratio:.2f}**" if self.is_worse else f"{self.ratio:.2f}"
        return f"| {self.name} | {numbers} | {self.new.unit} | {ratio} |"


@dataclass(frozen=True)
class Comparison:
    """Changed numbers, figures that are no longer measured, and notes on other differences."""

    changes: tuple[Change, ...]
    lost: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def regressions(self) -> tuple[Change, ...]:
        """Changes for the worse, beyond the margin."""
        return tuple(change for change in self.changes if change.is_worse)


def compare_records(old: Record, new: Record) -> Comparison:
    """Compare the figures of both records that one command measured on one anatomy.

    Raises
    ------
    InputError
        Records without a common figure.
    """
    before = {entry.name: entry for entry in old.rows if entry.values}
    both = [(before[entry.name], entry) for entry in new.rows if entry.name in before]
    same = [pair for pair in both if _alike(*pair)]
    changes = tuple(change for pair in same for change in _changes(*pair))
    lost = tuple(f"{mine.name}: {why}" for theirs, mine in same if (why := _lost(theirs, mine)))
    if not changes and not lost:
        raise InputError(
            "the two records have no figure in common that one command measured on one anatomy: "
            "measure one of them anew, with the --only and --anatomy of the other."
        )
    here = {entry.name for entry in new.rows}
    notes = [f"{name} is not compared: the new record does not have it." for name in before if name not in here]
    notes += [note for pair in both for note in _notes(*pair)]
    return Comparison(changes, lost, tuple(dict.fromkeys(notes)))


def _alike(old: Entry, new: Entry) -> bool:
    return old.command == new.command and old.origin.anatomy == new.origin.anatomy


def _lost(old: Entry, new: Entry) -> str:
    """Return the reason why a figure or one of its numbers is missing in the new record; empty if none is."""
    if new.state == "failed" or (new.state == "missed" and old.state == "measured"):
        return new.reason
    here = {value.name for value in new.values}
    gone = [value.name for value in old.values if value.name not in here]
    return f"it has no number for {', '.join(gone)}" if gone and new.state != "skipped" else ""


def _changes(old: Entry, new: Entry) -> list[Change]:
    known = {value.name: value for value in old.values}
    return [
        Change(f"{new.name}, {value.name}", known[value.name], value) for value in new.values if value.name in known
    ]


def _notes(old: Entry, new: Entry) -> list[str]:
    if not _alike(old, new):
        return [f"{new.name} is not compared: it was measured by another command, or on another anatomy."]
    notes = [f"{new.name} is not compared: {new.reason}."] if new.state == "skipped" else []
    for what in ("version", "machine"):
        was, now = (getattr(entry.origin, what) for entry in (old, new))
        if was != now:
            notes.append(f"The {what} differs. Before: {was}. Now: {now}.")
    return notes
