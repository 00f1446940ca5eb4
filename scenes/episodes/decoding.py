"""What a decoder of TOML says of a plan, in words of the plan."""

from __future__ import annotations

import re

KINDS = {
    "object": "a table", "array": "a list", "str": "text in quotation marks", "float": "a number",
    "int": "a whole number", "bool": "true or false", "null": "nothing",
}  # fmt: skip
"""Kinds of values, by the names that msgspec has for them."""


def said_plainly(error: str) -> str:
    """An error of msgspec as a sentence that begins with the key in question; what else it says stays as it is."""
    words, _, place = error.partition(" - at `$.")
    table = place.rstrip("`")
    strange, missing = (re.search(rf"{kind} field `(.*?)`", words) for kind in ("unknown", "required"))
    if strange is not None:
        return f"{_within(table, strange[1])}: there is no such key: look how it is spelled."
    if missing is not None:
        return f"{_within(table, missing[1])}: is missing. Give it."
    if table and words.startswith("Expected"):
        return f"{table}: {_named(words)}."
    return f"{table and f'{table}: '}{words}."


def _within(table: str, key: str) -> str:
    return f"{table}.{key}" if table else key


def _named(words: str) -> str:
    """What was expected, with kinds by their names."""

    def kinds(found: re.Match) -> str:
        names = [one.strip() for one in str(found[1]).split("|")]
        return " or ".join(KINDS.get(name, name) for name in names)

    plain = re.sub(r"`(.*?)`", kinds, words)
    return plain.replace("Expected ", "give ").replace(", got ", ", and not ")
