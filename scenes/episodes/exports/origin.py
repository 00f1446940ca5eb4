"""Whose brain the episodes' anatomies are, and the notice that goes with the template."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from ...script.shipped_files import template_path
from ..reading.bodies import is_template
from ..reading.contents import Contents
from .drawn import parameters_of

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
