"""Table of the keys of a plan, from the code that reads plans."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import msgspec

from scenes.episodes.draws import Distribution, ValueLimits
from scenes.episodes.plan import PlanContents

MEANINGS: dict[str, str] = tomllib.loads(Path(__file__).with_name("plan_meanings.toml").read_text(encoding="utf-8"))
"""Meaning of each key."""


@dataclass(frozen=True)
class PlanKey:
    """Key of a plan: full name, limits or possible words, and default."""

    name: str
    about: ValueLimits | tuple[str, ...] | None
    default: object

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Cells of its row, without the meaning."""
        if not isinstance(self.about, ValueLimits):
            return f"`{self.name}`", "", ", ".join(self.about or ()), self.said
        unit = "" if self.about.unit == "1" else self.about.unit
        return f"`{self.name}`", unit, f"{self.about.low:,g} to {self.about.high:,g}", self.said

    @property
    def said(self) -> str:
        """Default in words."""
        match self.default:
            case msgspec.NODEFAULT:
                return "must be given"
            case bool():
                return str(self.default).lower()
            case float() | int():
                return f"{self.default:g}"
            case (int() as width, int() as height):
                return f"{width} x {height}"
            case tuple() as ends:
                return " to ".join(f"{end:g}" for end in ends)
            case list() as words:
                return "any" if tuple(words) == self.about else ", ".join(words)
        return str(self.default)


def list_keys(table: type[msgspec.Struct], above: str = "") -> Iterator[PlanKey]:
    """Keys of a table and of its subtables; `above` is the table's name and a dot."""
    hints = get_type_hints(table, include_extras=True)
    for field in msgspec.structs.fields(table):
        kind = hints[field.name]
        tables = [one for one in (kind, *get_args(kind)) if isinstance(one, type) and issubclass(one, msgspec.Struct)]
        if tables and tables != [Distribution]:
            yield from list_keys(tables[0], f"{above}{field.name}.")
            continue
        made = field.default is msgspec.NODEFAULT and field.default_factory is not msgspec.NODEFAULT
        about = get_args(kind)[1] if get_origin(kind) is Annotated else None
        yield PlanKey(above + field.name, about, field.default_factory() if made else field.default)


def plan_table() -> str:
    """Build the table of all keys."""
    rows = [f"| {' | '.join(key.cells)} | {MEANINGS[key.name]} |" for key in list_keys(PlanContents)]
    return "\n".join(["| key | unit | possible values | default | meaning |", "|---|---|---|---|---|", *rows]) + "\n"
