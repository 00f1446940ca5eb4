"""Where things are on the page: the picture pinned and growing with the window, words, controls and 3-D view around it.

viser places panels in pixels; these rules go over its own. Its elements have no names, so they are found by what they
hold. In a wide window the controls stand in two columns, so that all are in sight. A browser that knows no `:has()`
leaves the rules aside and shows picture and controls in one docked panel.
"""

from __future__ import annotations

from .page_sight import PICTURE, SAID

PAGE, STATUS = "sulcus", "sulcus-status"
"""Names of the elements that hold the words under the picture, and the line over it."""
NOTE = "sulcus-note"
"""Class of the words of a note."""
PANEL = f"div:has(canvas) ~ div:has(#{PAGE})"
VIEW = f"div:has(canvas):has(~ div #{PAGE})"
PARTS = f"div:has(> div > #{SAID})"
NOTES = ".mantine-Notifications-root"

RULES = """
:root { --w: min(62vw, calc((100vh - 10.5rem) * var(--aspect))); --low: max(29vh, 9rem); }
#PAGE { font-size: 0.82rem; line-height: 1.35; box-sizing: border-box; padding: 0.45rem 0.8rem;
  overflow-wrap: anywhere }
#PAGE p, #SAID p { margin: 0 0 0.3rem 0 }
#PAGE .legend { display: flex; flex-wrap: wrap; gap: 0.1rem 1rem; margin-bottom: 0.3rem }
#PAGE .legend span { display: inline-flex; align-items: center; gap: 0.4rem; white-space: nowrap }
#PAGE .dim, #SAID .dim { opacity: 0.62 }
#SAID { font-size: 0.88rem; line-height: 1.4; padding: 0 0.75rem 0.4rem; overflow-wrap: anywhere }
#SAID .stale { opacity: 0.5 }
#SAID .warn { color: #ff922b; font-weight: 600 }
#SAID .number { font-size: 1.25rem; font-weight: 600 }
#SAID table { border-collapse: collapse; font-size: 0.8rem; margin-bottom: 0.3rem }
#SAID .best { font-weight: 700 }
#SAID td, #SAID th { padding: 0 0.9rem 0 0; text-align: left; font-weight: inherit }
.NOTE { font-size: 0.8rem; line-height: 1.4; padding: 0 0.75rem 0.4rem; overflow-wrap: anywhere }
.NOTE ul { margin: 0; padding-left: 1.1rem }
#STATUS { position: fixed; top: 0.6rem; right: calc(100vw - var(--w) + 0.6rem); z-index: 7; pointer-events: none }
#STATUS span { background: #e8590c; color: #fff; border-radius: 0.3rem; padding: 0.2rem 0.6rem; font-size: 0.9rem }
PANEL #PICTURE { position: fixed; left: 0; top: 0; width: var(--w); aspect-ratio: var(--aspect); background: #181818;
  z-index: 6 }
#PICTURE img { width: 100%; display: block }
NOTES { top: auto !important; bottom: 0.5rem; left: calc(var(--w) + 0.5rem) !important }
#webgl-software-rendering { display: none }
@media (min-width: 36.01em) {
  PANEL { left: var(--w) !important; right: 0 !important; width: auto !important; bottom: var(--low) !important }
  PANEL > div:first-child, PANEL > div:last-child { display: none !important }
  PANEL > div > div { width: 100% !important }
  VIEW { inset: auto 0 0 var(--w) !important; height: var(--low); border-top: 1px solid #444 }
  #PAGE { position: fixed; left: 0; top: calc(var(--w) / var(--aspect)); width: var(--w); bottom: 0; overflow: auto }
}
@media (min-width: 75em) and (min-aspect-ratio: 13/10) {
  PARTS { display: grid; grid-template-columns: 1fr 1fr; align-items: center }
  PARTS > * { grid-column: 1 / -1 }
  PARTS > div:has(> button), PARTS > div:has(> .mantine-Flex-root) { grid-column: auto }
}
@media (min-width: 75em) and (min-aspect-ratio: 13/10) and (max-height: 50em) {
  :root { --low: max(22vh, 9rem) }
}
@media (min-width: 36.01em) and (max-aspect-ratio: 13/10) {
  PANEL { bottom: 0 !important }
  VIEW { inset: auto calc(100vw - var(--w)) 0 0 !important }
  #PAGE { bottom: var(--low) }
  NOTES { left: 0.5rem !important }
}
@media (max-width: 36em) {
  :root { --w: 100vw; --low: 17vh }
  PANEL { left: 0; top: calc(100vw / var(--aspect)); width: 100% !important; max-height: none !important;
    bottom: var(--low) !important }
  PANEL div[style*="20em"] { width: 100% !important }
  VIEW { position: absolute !important; inset: auto 0 0 0 !important; height: var(--low) !important }
  #PAGE { font-size: 0.78rem }
  #STATUS span { font-size: 0.75rem }
  #SAID { font-size: 0.82rem; max-height: 11.4rem; overflow-y: auto }
  NOTES { left: 0.5rem !important }
}
"""


def style(aspect: float) -> str:
    """An element of rules for a picture of width / height `aspect`."""
    rules = RULES
    for name, value in (
        ("#PICTURE", f"#{PICTURE}"),
        ("PANEL", PANEL),
        ("VIEW", VIEW),
        ("PARTS", PARTS),
        ("NOTES", NOTES),
        ("#PAGE", f"#{PAGE}"),
        ("#STATUS", f"#{STATUS}"),
        ("#SAID", f"#{SAID}"),
        (".NOTE", f".{NOTE}"),
    ):
        rules = rules.replace(name, value)
    return f"<style>:root {{ --aspect: {aspect:.4f} }}{rules}</style>"
