"""Styles of drawing a hidden surface, and the layers that it may be seen through."""

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
"""Display names of the styles, by their names in code."""
MIN_REPORTED_SHARE = 0.1  # Smallest reported share of the silhouette that closed ground covers.
WHOLE_SHARE = 0.9  # Share of the silhouette above which closed ground is reported without "partly".


@dataclass(frozen=True)
class Opening:
    """Layers through which the hidden surface may be drawn as if visible (open ground).

    Under other layers (closed ground), the outline is broken and the surface does not shine through.

    Parameters
    ----------
    ids
        Ids of the open layers, such as cortex.
    labels
        Ids and labels of other layers, such as a drape.
    default_label
        Label of other layers that are not in `labels`.
    """

    ids: tuple[int, ...]
    labels: tuple[tuple[int, str], ...] = ()
    default_label: str = "not in the open"

    def describe(self, pixel_counts: Mapping[int, int]) -> str:
        """Return the label of the closed ground over the silhouette; empty if its share is too small.

        `pixel_counts` has the number of silhouette pixels by the id of the layer over them, occluders excluded.
        """
        under: dict[str, int] = {}
        for layer, count in pixel_counts.items():
            if layer not in self.ids:
                words = dict(self.labels).get(layer, self.default_label)
                under[words] = under.get(words, 0) + count
        total, shut = sum(pixel_counts.values()), sum(under.values())
        if not total or shut < MIN_REPORTED_SHARE * total:
            return ""
        most = max(under, key=lambda words: under[words])
        return most if shut >= WHOLE_SHARE * total else f"partly {most}"
