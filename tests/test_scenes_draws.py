"""Every key of a plan: the page says its unit, limits and default as the code has them, and refusals name limits."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import msgspec
import pytest

from scenes.episodes.draws import Distribution, ValueLimits
from scenes.episodes.families import FamilyMotions
from scenes.episodes.plan import PlanContents, plan_from
from sim.errors import InputError

PAGE = Path(__file__).parents[1] / "docs/reference/plan_keys.md"


@dataclass(frozen=True)
class Key:
    """A key by its full name; its limits, or the words that are known, and its default."""

    name: str
    about: ValueLimits | tuple[str, ...] | None
    default: object

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Its row, without what it means."""
        if not isinstance(self.about, ValueLimits):
            return f"`{self.name}`", "", ", ".join(self.about or ()), self.said
        unit = "" if self.about.unit == "1" else self.about.unit
        return f"`{self.name}`", unit, f"{self.about.low:,g} to {self.about.high:,g}", self.said

    @property
    def said(self) -> str:
        """The default in words."""
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


def keys_of(table: type[msgspec.Struct], above: str = "") -> Iterator[Key]:
    """Those of a table and of the tables in it; `above` is its name and a dot."""
    hints = get_type_hints(table, include_extras=True)
    for field in msgspec.structs.fields(table):
        kind = hints[field.name]
        tables = [one for one in (kind, *get_args(kind)) if isinstance(one, type) and issubclass(one, msgspec.Struct)]
        if tables and tables != [Distribution]:
            yield from keys_of(tables[0], f"{above}{field.name}.")
            continue
        made = field.default is msgspec.NODEFAULT and field.default_factory is not msgspec.NODEFAULT
        about = get_args(kind)[1] if get_origin(kind) is Annotated else None
        yield Key(above + field.name, about, field.default_factory() if made else field.default)


KEYS = list(keys_of(PlanContents))
LIMITED = [key for key in KEYS if isinstance(key.about, ValueLimits)]


def test_the_page_has_every_key_as_the_code_has_it():
    """To mend the page, copy what this prints of the row that differs."""
    assert len(KEYS) > 70 and {key.name.split(".")[1] for key in KEYS if "motion." in key.name} == set(
        FamilyMotions.__struct_fields__
    )
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    found = [tuple(cell.strip() for cell in row.strip("|").split("|")) for row in rows]
    assert [row[:4] for row in found] == [key.cells for key in KEYS]
    assert all(meaning for *_, meaning in found)


def with_value(key: Key, value: float) -> str:
    """A plan with one value."""
    *tables, last = key.name.split(".")
    size = f"[{value}, 64]" if last == "size" else str(value)
    kinds = {"tumour": "drawn", "tissue": "own.vtu"} if tables[:1] == ["bodies"] else {}
    more = f'anatomies = "{kinds[tables[1]]}"\n' if tables[1:] and tables[1] in kinds else ""
    own = f"[{'.'.join(tables)}]\n{last} = {size}\n" if tables else ""
    play = "" if key.name.startswith("motion.") else "[motion.press]\n"
    return f'title = "x"\n{"" if tables else f"{last} = {size}"}\n{play}{"[bodies]" if more else ""}\n{more}{own}'


@pytest.mark.parametrize("key", LIMITED, ids=lambda key: key.name)
def test_a_refusal_names_the_key_and_its_limits(key):
    step = max(1, round(1e-3 * key.about.high)) if isinstance(key.default, int) or key.name == "size" else 1e-3
    for value in (key.about.low - step, key.about.high + step):
        with pytest.raises(InputError) as refused:
            plan_from(with_value(key, value), "mine")
        assert f"{key.name}: {value}" in str(refused.value) and f"{key.about}" in str(refused.value)
    plan_from(with_value(key, key.about.high), "mine")  # what is possible is taken
