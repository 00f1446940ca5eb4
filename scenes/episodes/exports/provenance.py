"""Whose brain the episodes' anatomies are, what was drawn for them, and the notice of the template."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from ...script.shipped_files import template_path
from ..reading.bodies import is_template
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


TEMPLATE, DRAWN, UNKNOWN = "template", "drawn", ""
"""Whose an anatomy is: the one that ships, the same brain with another tumour, or not said; else the name of an own."""


def origin_of(contents: Contents) -> str:
    """Whose an episode's anatomy is: `TEMPLATE`, `DRAWN`, the name of an own one, or `UNKNOWN`."""
    stated = parameters_of(contents).get("bodies.anatomies")
    if stated is not None:
        return str(stated)
    return TEMPLATE if is_template(str(contents.said.get("anatomy"))) else UNKNOWN


def notice_of_template() -> str:
    """What those who made the template ask to appear in all copies, as Markdown."""
    lines = template_path().with_suffix(".notice.txt").read_text(encoding="utf-8").splitlines()
    head = "The template's brain, also in `bodies`, is made from the ICBM 152 template of 2009 (MNI152). Its notice:"
    return "\n".join(["", head, "", *(f"> {line}" for line in lines), ""])


def of_template(episodes: Sequence[Contents]) -> bool:
    """Whether any of them is of the template's brain."""
    return any(origin_of(one) in (TEMPLATE, DRAWN) for one in episodes)


def origins(episodes: Sequence[Contents]) -> Iterator[str]:
    """Lines of the data sheet."""
    for origin, count in Counter(origin_of(one) for one in episodes).most_common():
        if origin in (TEMPLATE, DRAWN):
            tumour = "one and the same" if origin == TEMPLATE else "drawn"
            yield (
                f"- In {count} episodes the brain is the ICBM 152 template's of 2009 (MNI152), as nilearn "
                "ships it, scaled to a person's. It is an average of 152 healthy adults, and nobody's own. "
                f"Tumour and opening were put into it; they are {tumour}."
            )
        elif origin == UNKNOWN:
            yield f"- In {count} episodes the files do not say whose brain it is: write it here."
        else:
            yield f"- In {count} episodes the anatomy is the maker's own, `{origin}`. Write here whose it is."
