"""A picture and words as one message, which the visitor's browser shows at one moment, each in a place of its own.

A browser loads pictures later than it sets words, and drops a picture that is replaced before it is loaded. A slow
browser would show new words beside an old picture. So both wait, out of sight, until the picture is loaded.
"""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np

from ..overlay.hud import BREAK

QUALITY = 88
PICTURE, SAID, NEXT = "sulcus-picture", "sulcus-said", "sulcus-next"
"""Names of the elements that hold the picture, the words beside it, and what waits to take their places."""
SLICES, HISTORY = "sulcus-slices", "sulcus-history"
"""Names of the elements that hold slices of the scan, and the last seconds."""


@dataclass(frozen=True)
class Spot:
    """Where a picture and its words go, and where they wait: names of elements; `alt` says what the picture is."""

    picture: str
    words: str
    waits: str
    alt: str


MAIN = Spot(PICTURE, SAID, NEXT, "what the camera sees")
ASIDE = Spot(SLICES, HISTORY, "sulcus-next-aside", "axial, coronal and sagittal slices of the scan")
# Of pictures that are loaded in another order than they came, an older one is left out.
SWAP = """
const words = this.parentNode.querySelector('template').content, number = Number(this.dataset.number);
const picture = document.getElementById('PICTURE'), said = document.getElementById('SAID');
if (number >= Number(picture.dataset.number || 0)) {
  picture.dataset.number = number;
  this.onload = null;
  picture.replaceChildren(this);
  said.replaceChildren(words.cloneNode(true));
}
"""


def unparted(words: str) -> str:
    """Words, HTML, in which no new line parts a number from its name, its error and its unit: as in a picture."""
    return re.sub(
        r"<[^>]*>|\s+",
        lambda part: part[0] if part[0][0] == "<" or BREAK.match(words, part.start()) else "&nbsp;",
        words,
    )


def coded(colour: np.ndarray) -> str:
    """A picture (H, W, 3) uint8 as an address that holds it."""
    written = cv2.imencode(".jpg", cv2.cvtColor(colour, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(written.tobytes()).decode()}"


def sight(number: int, picture: str, words: str, spot: Spot = MAIN) -> str:
    """An element that puts a `coded` picture and words, HTML, into their places; `number` counts them."""
    swap = escape(" ".join(SWAP.replace("PICTURE", spot.picture).replace("SAID", spot.words).split()))
    # Decoded with the rest of the page: else the words are painted first.
    image = f'<img alt="{spot.alt}" decoding="sync" data-number="{number}" onload="{swap}" src="{picture}">'
    return f'<div id="{spot.waits}" hidden>{image}<template>{words}</template></div>'
