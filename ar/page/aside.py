"""What stands in the 3-D view's place when a visitor asks for it: slices of the scan, the last seconds; and the keys.

Tabs, keys and names of controls are of the visitor's own browser: the server hears of none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from .parts import Key
from .sight import HISTORY, SLICES

ASIDE, HELP = "sulcus-aside", "sulcus-keys"
"""Names of the elements that hold the tabs with what they show, and the list of keys."""
TABS = (("3-D view", "sulcus-tab-view"), ("slices", "sulcus-tab-slices"), ("last 20 s", "sulcus-tab-history"))
"""What the tabs are called, and the names of their buttons."""
CAPTION = (
    "The scan as it was taken. Dotted: the tumour in the scan; green: now; band: where its outline is, 95 of 100 times "
    "by the error that is named (none: not known). White: the tool; a ring: its tip, beside the slice."
)
# An image of one pixel: loading it runs the script, which an element's HTML alone would not.
PIXEL = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="


SPACE = Key(" ", "space", "space", "play or pause")
BACK, ON = (
    Key("ArrowLeft", "arrowleft", "\N{LEFTWARDS ARROW}", "one frame back"),
    Key("ArrowRight", "arrowright", "\N{RIGHTWARDS ARROW}", "one frame on"),
)
STYLE = Key("s", "S", "s", "next overlay")
RECORD = Key("r", "R", "r", "start or stop recording")
LIVE_KEYS = (SPACE, STYLE, RECORD)
KEYS = (SPACE, BACK, ON, STYLE, RECORD)
"""The keys that the server hears of: of a page without frames to go to, and of any other."""
# In the 3-D view arrows and letters move the camera: a key of ours goes to viser's own commands alone, which listen on
# the document's element. What is being typed into, or is moved by arrows, keeps its keys.
SCRIPT = """
if (!window.sulcusKeys) {
  window.sulcusKeys = [KEYS];
  const help = () => document.getElementById('HELP');
  document.body.addEventListener('keydown', event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const typed = event.target.closest('input:not([type=radio]), textarea, select, [role=slider], dialog[open]');
    if (event.key === '?' && !(typed && typed.matches('input, textarea, dialog'))) { help().showModal(); return; }
    const key = event.key.length > 1 ? event.key : event.key.toLowerCase();
    if (!window.sulcusKeys.includes(key)) return;
    event.stopPropagation();
    if (typed || (key === ' ' && event.target.closest('button, summary, a'))) return;
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


def aside(keys: Sequence[Key] = KEYS) -> str:
    """An element with the tabs, empty places for slices and for the last seconds, and the list of keys."""
    tabs = "".join(
        f'<input type="radio" name="{ASIDE}" id="{name}"{" checked" if number == 0 else ""}>'
        f'<label for="{name}">{words}</label>'
        for number, (words, name) in enumerate(TABS)
    )
    rows = "".join(f"<tr><td><kbd>{key.shown}</kbd></td><td>{key.does}</td></tr>" for key in keys)
    rows += "<tr><td><kbd>?</kbd></td><td>this list</td></tr><tr><td><kbd>Enter</kbd></td><td>press a button</td></tr>"
    listed = ", ".join(f"'{key.name}'" for key in keys)
    script = escape(" ".join(SCRIPT.replace("KEYS", listed, 1).replace("HELP", HELP).split()))
    opens = f"document.getElementById('{HELP}').showModal()"
    return (
        f'<div id="{ASIDE}">{tabs}<button type="button" aria-label="list of keys" onclick="{opens}">keys</button>'
        f'<div class="shown"><div id="{SLICES}"></div><p>{CAPTION}</p></div>'
        f'<div class="shown"><div id="{HISTORY}"></div></div>'
        f'<dialog id="{HELP}" aria-label="keys"><table>{rows}</table>'
        f'<form method="dialog"><button>close</button></form></dialog>'
        f'<img alt="" hidden src="{PIXEL}" onload="{script}"></div>'
    )
