"""What was drawn at random for episodes: tables of what varies, and of what is the same in all."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from ..reading.contents import Contents

# Longest of each list.
MOST_DRAWN = 100


def parameters_of(contents: Contents) -> dict[str, Any]:
    """What an episode says was drawn for it, by dotted names; nothing where it does not say, or not as JSON.

    Tumours are drawn for anatomies that are drawn: those of others are left out, as nothing came of them.
    """
    try:
        found = dict(leaves(json.loads(contents.said.get("parameters", "{}"))))
    except (TypeError, ValueError, RecursionError):
        return {}
    placed = found.get("bodies.anatomies", "drawn") == "drawn"
    return {key: value for key, value in found.items() if placed or not key.startswith("bodies.tumour.")}


def drawn_tables(episodes: Sequence[Contents]) -> Iterator[str]:
    """Lines of two tables: ranges of numbers and how often each text came; what is the same wherever it is."""
    values: dict[str, list[Any]] = {}
    for one in episodes:
        for key, value in parameters_of(one).items():
            values.setdefault(key, []).append(value)
    varied = {key: found for key, found in values.items() if any(one != found[0] for one in found)}
    same = {key: found for key, found in values.items() if key not in varied}
    if not values:
        yield "\nNothing was drawn at random, or the files do not say what."
    if varied:
        yield "\nWhat was drawn at random, from least to greatest:\n"
        yield "| what | from | to | episodes |\n|---|---|---|---|"
        yield from [range_row(key, found) for key, found in varied.items()][:MOST_DRAWN]
    if same:
        yield "\nWhat is the same in all episodes that have it:\n"
        yield "| what | value | episodes |\n|---|---|---|"
        yield from [f"| `{key}` | {said(found[0])} | {len(found)} |" for key, found in same.items()][:MOST_DRAWN]


def range_row(key: str, found: Sequence[Any]) -> str:
    """A row of what varies."""
    if all(is_number(one) for one in found):
        return f"| `{key}` | {said(min(found))} | {said(max(found))} | {len(found)} |"
    often = ", ".join(f"{text} ({count})" for text, count in Counter(map(str, found)).most_common(8))
    return f"| `{key}` | {often} | | {len(found)} |"


def is_number(value: Any) -> bool:
    """Whether a value is a number, which true and false are not here."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def said(value: Any) -> str:
    """A value in a table: whole numbers in full, others to four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers and texts of nested JSON by their dotted names; lists are numbered."""
    match value:
        case dict():
            for key, inner in value.items():
                yield from leaves(inner, f"{name}.{key}".strip("."))
        case list():
            for place, inner in enumerate(value):
                yield from leaves(inner, f"{name}.{place}".strip("."))
        case _:
            yield name, value
