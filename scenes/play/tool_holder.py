"""Who of the visitors to a page has the tool, in the words that each of them reads."""

from __future__ import annotations

from collections.abc import Collection


def holding(visitor: int, holder: int | None, here: Collection[int]) -> str:
    """Return the line that a visitor reads.

    Parameters
    ----------
    visitor
        Whose line it is.
    holder
        Who took the tool last; None where the script has it.
    here
        Who looks at the page.
    """
    if holder is None:
        held = "the script moves the tool"
    elif holder == visitor:
        held = "**you hold the tool**"
    elif holder in here:
        held = f"another visitor (number {holder}) holds the tool"
    else:
        held = f"visitor {holder} held the tool and has left: it stays where it was put"
    many = len(here)
    return held if many < 2 else f"{held}; {many} visitors look, you are number {visitor}"
