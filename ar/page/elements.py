"""HTML elements of the page: image and text as one message; tabs for slices and charts; keys.

A browser loads an image later than it shows text, and drops an image that is replaced before it is loaded. A slow
browser would thus show new text next to an old image. Therefore both are hidden until the image is loaded.

Tabs, keys and accessible names of controls exist only in the browser; the server does not receive them.
"""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np

from ..overlay.hud import BREAK_PATTERN
from .parts import Key, SceneSurface

JPEG_QUALITY = 88  # JPEG quality of images on the page, 0 to 100.
PICTURE, SAID, NEXT = "sulcus-picture", "sulcus-said", "sulcus-next"
"""Ids of the elements with the image, with the text next to it, and with the hidden next image and text."""
SLICES, HISTORY = "sulcus-slices", "sulcus-history"
"""Ids of the elements with the slices of the scan, and with the charts of the last seconds."""


@dataclass(frozen=True)
class ImageElementIds:
    """Ids of the elements for an image, its text, and the waiting next ones; `alt` describes the image."""

    image: str
    text: str
    waiting: str
    alt: str


MAIN = ImageElementIds(PICTURE, SAID, NEXT, "camera image with overlay")  # Elements of the camera image.
# Elements of the slices.
ASIDE_SPOT = ImageElementIds(SLICES, HISTORY, "sulcus-next-aside", "axial, coronal and sagittal slices of the scan")
# Script that shows the next image. If images are loaded out of order, older ones are dropped.
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


def keep_numbers_together(html: str) -> str:
    """Replace spaces between a number and its name, error or unit in HTML by no-break spaces; return the HTML."""
    return re.sub(
        r"<[^>]*>|\s+",
        lambda part: part[0] if part[0][0] == "<" or BREAK_PATTERN.match(html, part.start()) else "&nbsp;",
        html,
    )


def to_data_url(image: np.ndarray) -> str:
    """Encode an image (H, W, 3) uint8 as a data URL with a JPEG."""
    written = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(written.tobytes()).decode()}"


def build_image_element(number: int, data_url: str, html: str, ids: ImageElementIds = MAIN) -> str:
    """Build the element that shows a `to_data_url` image with text (HTML) once it is loaded; `number` counts these."""
    swap = escape(" ".join(SWAP.replace("PICTURE", ids.image).replace("SAID", ids.text).split()))
    # Decoded synchronously: otherwise the words would be painted first.
    image = f'<img alt="{ids.alt}" decoding="sync" data-number="{number}" onload="{swap}" src="{data_url}">'
    return f'<div id="{ids.waiting}" hidden>{image}<template>{html}</template></div>'


ASIDE, HELP = "sulcus-aside", "sulcus-keys"
"""Ids of the elements with the tabs and their content, and with the list of keys."""
TABS = (("3-D view", "sulcus-tab-view"), ("slices", "sulcus-tab-slices"), ("last 20 s", "sulcus-tab-history"))
"""Labels of the tabs, and ids of their buttons."""
DETAILS = "sulcus-details"
"""Id of the checkbox that shows the details of a result."""
OPEN_DETAILS = f'<label class="more" for="{DETAILS}">details</label><div class="details">'
"""HTML before the details of a result, which end with `</div>` and are shown after a click on the label."""
CAPTION = (  # Text under the slices.
    "The scan as it was taken. Dotted: the tumour in the scan; green: now; band: 95 % error of its "
    "outline, by the named source (none: not known). White: tool in the slice; ring: tip outside the slice."
)
# Image of one pixel: when it is loaded, its script runs; a script element in the HTML would not run.
PIXEL = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="


PLAY_KEY = Key(" ", "space", "space", "play or pause")  # Key that plays or pauses.
BACK_KEY, ON_KEY = (  # Keys that move one frame back and one frame on.
    Key("ArrowLeft", "arrowleft", "\N{LEFTWARDS ARROW}", "previous frame"),
    Key("ArrowRight", "arrowright", "\N{RIGHTWARDS ARROW}", "next frame"),
)
STYLE_KEY = Key("s", "S", "s", "next overlay")  # Key that selects the next overlay.
RECORD_KEY = Key("r", "R", "r", "start or stop recording")  # Key that starts or stops a recording.
LIVE_KEYS = (PLAY_KEY, STYLE_KEY, RECORD_KEY)  # Keys of a page without frames to seek.
KEYS = (PLAY_KEY, BACK_KEY, ON_KEY, STYLE_KEY, RECORD_KEY)
"""Keys that the server receives, for a page with frames to seek (`LIVE_KEYS`: without such frames)."""
# In the 3-D view arrows and letters move the camera: our keys go to viser's own commands alone, which listen on the
# document's element. Text fields, and sliders that arrows move, keep their keys.
SCRIPT = """
if (!window.sulcusKeys) {
  window.sulcusKeys = [KEYS];
  const help = () => document.getElementById('HELP');
  document.body.addEventListener('keydown', event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const field = 'input:not([type=radio], [type=checkbox]), textarea, select, [role=slider], dialog[open]';
    const typed = event.target.closest(field);
    if (event.key === '?' && !(typed && typed.matches('input, textarea, dialog'))) { help().showModal(); return; }
    const key = event.key.length > 1 ? event.key : event.key.toLowerCase();
    if (!window.sulcusKeys.includes(key)) return;
    event.stopPropagation();
    if (typed || (key === ' ' && event.target.closest('button, summary, a, [type=checkbox]'))) return;
    event.preventDefault();
    document.documentElement.dispatchEvent(new KeyboardEvent('keydown', {key: key, code: event.code}));
  });
  const named = () => {
    for (const field of document.querySelectorAll('[role=slider], input:not([type=hidden])')) {
      const row = field.closest('.mantine-Flex-root:has(label), .mantine-InputWrapper-root:has(label)');
      const label = row && row.querySelector('label');
      if (label && !field.getAttribute('aria-label')) field.setAttribute('aria-label', label.textContent);
    }
    const view = document.querySelector('canvas');
    if (view) view.setAttribute('aria-label', '3-D view of the brain, the tumour and the tool');
  };
  setInterval(named, 1000);
}
"""


def build_tabs(keys: Sequence[Key] = KEYS, surfaces: Sequence[SceneSurface] = ()) -> str:
    """Build the element with tabs, legend of surfaces, places for slices and charts, and list of keys."""
    tabs = "".join(
        f'<input type="radio" name="{ASIDE}" id="{name}"{" checked" if number == 0 else ""}>'
        f'<label for="{name}">{words}</label>'
        for number, (words, name) in enumerate(TABS)
    )
    rows = "".join(f"<tr><td><kbd>{key.symbol}</kbd></td><td>{key.action}</td></tr>" for key in keys)
    rows += "<tr><td><kbd>?</kbd></td><td>this list</td></tr><tr><td><kbd>Enter</kbd></td><td>press a button</td></tr>"
    listed = ", ".join(f"'{key.name}'" for key in keys)
    script = escape(" ".join(SCRIPT.replace("KEYS", listed, 1).replace("HELP", HELP).split()))
    opens = f"document.getElementById('{HELP}').showModal()"
    legend = "".join(
        f'<span><b style="color: rgb({" ".join(f"{c:.0%}" for c in body.colour)})">&#9632;</b> {body.meaning}</span>'
        for body in reversed(surfaces)
        if body.meaning
    )
    return (
        f'<div id="{ASIDE}">{tabs}<input type="checkbox" id="{DETAILS}" aria-label="details of the result">'
        f'<button type="button" aria-label="list of keys" onclick="{opens}">keys</button>'
        f'<p class="key">{legend}</p>'
        f'<div class="shown"><div id="{SLICES}"></div><p>{CAPTION}</p></div>'
        f'<div class="shown"><div id="{HISTORY}"></div></div>'
        f'<dialog id="{HELP}" aria-label="keys"><table>{rows}</table>'
        f'<form method="dialog"><button>close</button></form></dialog>'
        f'<img alt="" hidden src="{PIXEL}" onload="{script}"></div>'
    )
