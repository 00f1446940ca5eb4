"""Tables of what the files hold, from the code that writes them."""

from __future__ import annotations

from scenes.episodes.episode import MEANINGS as EPISODE
from scenes.episodes.episode import UNITS
from surrogate.data.array_meanings import GROUP_DESCRIPTIONS
from surrogate.data.array_meanings import MEANINGS as DATASET


def dataset_table() -> str:
    """Return the groups and arrays of a data set."""
    groups = [f"| `{name}/` | {text} |" for name, text in GROUP_DESCRIPTIONS.items()]
    arrays = [f"| `{name}` | {_unit(of.unit)} | {of.axes} | {of.text} |" for name, of in DATASET.items()]
    return _lines(
        ["| group | what it holds |", "|---|---|", *groups],
        ["| array | unit | axes | what it is |", "|---|---|---|---|", *arrays],
    )


def episode_table() -> str:
    """Arrays of an episode."""
    units = {f"pictures/{name}" if f"pictures/{name}" in EPISODE else name: unit for name, unit in UNITS.items()}
    rows = [f"| `{name}` | {_unit(units.get(name, ''))} | {text} |" for name, text in EPISODE.items()]
    more = [f"| `{name}` | {_unit(unit)} | |" for name, unit in units.items() if name not in EPISODE]
    return _lines(["| array | unit | what it is |", "|---|---|---|", *rows, *more])


def _unit(text: str) -> str:
    return "" if text == "1" else text


def _lines(*tables: list[str]) -> str:
    return "\n\n".join("\n".join(table) for table in tables) + "\n"
