"""How a hidden surface may be drawn, and what it is seen through."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

Style = Literal["window", "contour", "fill", "depth", "rings", "cut", "none"]
STYLES: Mapping[Style, str] = MappingProxyType(
    {
        "window": "outline and window",
        "contour": "outline",
        "fill": "outline and tint",
        "depth": "outline and depth",
        "rings": "outline and rings",
        "cut": "outline and cut",
        "none": "none",
    }
)
"""What each is, in words."""
# Shares of the silhouette in sight from which its ground is spoken of, and from which it is all of it.
NOTICED, WHOLE = 0.1, 0.9


@dataclass(frozen=True)
class Opening:
    """Ground through which a hidden surface may be drawn as if it were seen.

    Elsewhere its outline is broken and nothing shines through.

    Parameters
    ----------
    ids
        Of the layers that are such ground, as cortex.
    under
        What is said by the id of another layer under which it lies, as drape.
    otherwise
        What is said of layers without such words.
    """

    ids: tuple[int, ...]
    under: tuple[tuple[int, str], ...] = ()
    otherwise: str = "not in the open"

    def said(self, counts: Mapping[int, int]) -> str:
        """What a picture says of the ground; empty where too little lies elsewhere.

        counts: pixels of the silhouette by the id of the layer over it, without those in front of the overlay.
        """
        under: dict[str, int] = {}
        for layer, count in counts.items():
            if layer not in self.ids:
                words = dict(self.under).get(layer, self.otherwise)
                under[words] = under.get(words, 0) + count
        total, shut = sum(counts.values()), sum(under.values())
        if not total or shut < NOTICED * total:
            return ""
        most = max(under, key=lambda words: under[words])
        return most if shut >= WHOLE * total else f"partly {most}"
