"""The picture and the words beside it as one message, which the visitor's browser shows at one moment.

A browser loads pictures later than it sets words, and drops a picture that is replaced before it is loaded. A slow
browser would show new words beside an old picture. So both wait, out of sight, until the picture is loaded.
"""

from __future__ import annotations

import base64
from html import escape

import cv2
import numpy as np

QUALITY = 88
PICTURE, SAID, NEXT = "sulcus-picture", "sulcus-said", "sulcus-next"
"""Names of the elements that hold the picture, the words beside it, and what waits to take their places."""
# Of pictures that are loaded in another order than they came, an older one is left out.
SWAP = f"""
const words = this.parentNode.querySelector('template').content, number = Number(this.dataset.number);
const picture = document.getElementById('{PICTURE}'), said = document.getElementById('{SAID}');
if (number >= Number(picture.dataset.number || 0)) {{
  picture.dataset.number = number;
  this.onload = null;
  picture.replaceChildren(this);
  said.replaceChildren(words.cloneNode(true));
}}
"""


def coded(colour: np.ndarray) -> str:
    """A picture (H, W, 3) uint8 as an address that holds it."""
    written = cv2.imencode(".jpg", cv2.cvtColor(colour, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(written.tobytes()).decode()}"


def sight(number: int, picture: str, words: str) -> str:
    """An element that puts a `coded` picture and words, HTML, into their places; `number` counts them."""
    swap = escape(" ".join(SWAP.split()))
    # Decoded with the rest of the page: else the words are painted first.
    image = f'<img alt="what the camera sees" decoding="sync" data-number="{number}" onload="{swap}" src="{picture}">'
    return f'<div id="{NEXT}" hidden>{image}<template>{words}</template></div>'
