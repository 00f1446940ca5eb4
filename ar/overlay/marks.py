"""Arguments of `composite`: marks and words beside a hidden surface, and the cover over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..rendering.layer import Layer
from .gauge import Gauge
from .legend import Names
from .styles import Opening
from .traces import Trace

UNNAMED = Names()


@dataclass(frozen=True, eq=False)
class Cover:
    """Layers and ground over the hidden surface.

    Parameters
    ----------
    occluders
        Ids of the layers (tool, hand) that cover the overlay wherever the picture shows them.
    opening
        The ground that the surface may be seen through; None: any. Under other ground the outline is broken, nothing
        shines through, and the picture says what it lies under where that is a noticeable share.
    covered
        (H, W) bool: what covers the overlay besides the occluders, as a hand or cottonoids in a real picture.
    """

    occluders: Sequence[int] = ()
    opening: Opening | None = None
    covered: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Marks:
    """Lines that are drawn beside the hidden surface's outline.

    Parameters
    ----------
    margin
        One number or (V,) [m]: how uncertain the surface is. Where positive, a dashed second outline runs that far out.
    gauge
        Draws the line from the tip to the hidden surface, and its length in millimetres beside the tip.
    before
        Where the hidden surface was before, as in the scan: a dotted grey outline, with an arrow from there to here and
        the mean motion in millimetres.
    traces
        Outlines of other surfaces, drawn under the hidden one's.
    """

    margin: float | np.ndarray = 0.0
    gauge: Gauge | None = None
    before: Layer | None = None
    traces: Sequence[Trace] = ()


@dataclass(frozen=True, eq=False)
class Words:
    """Words in the picture.

    Parameters
    ----------
    doubt
        Why the surface's place may not be relied on. It is written at the picture's foot, see `doubt_lines`, whatever
        the style. The outline is amber and broken. Nothing is promised: no margin is drawn, and the number beside the
        tip has no error.
    head
        Lines that are written at the picture's head, whatever the style and whatever lies there.
    names
        What the lines are called in the legend, which is drawn where there is room.
    moved
        Length and error [m] to be written in place of the mean motion, which has none.
    error
        How far off the surface may be [m], for the words of the styles that measure; None where it is not known.
    """

    doubt: str = ""
    head: Sequence[str] = ()
    names: Names = UNNAMED
    moved: tuple[float, float] | None = None
    error: float | None = None


NO_COVER, NO_MARKS, NO_WORDS = Cover(), Marks(), Words()
