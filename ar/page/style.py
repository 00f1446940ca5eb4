"""Layout of the page: the image scales with the window; text, controls and 3-D view are placed round it.

These style rules replace viser's positions, which are in pixels. Viser's elements have no names, so the rules select
them by content. In a wide window the controls have two columns, so that all are visible. A browser without `:has()`
ignores the rules, and shows image and controls in one docked panel.
"""

from .client_page import NO_WEBGL_CLASS
from .elements import ASIDE, DETAILS, HELP, HISTORY, PICTURE, SAID, SLICES, TABS

PAGE, STATUS = "sulcus", "sulcus-status"
"""Ids of the elements with the text below the image, and with the status line over it."""
NOTE = "sulcus-note"
"""Class of the elements with the text of a note."""
PANEL = f"div:has(canvas) ~ div:has(#{PAGE})"  # Selector of the panel with the controls.
VIEW = f"div:has(canvas):has(~ div #{PAGE})"  # Selector of the 3-D view.
PARTS = f"div:has(> div > #{SAID})"  # Selector of the list of the panel's parts.
NOTES = ".mantine-Notifications-root"  # Selector of viser's notifications.

DIMMED = (  # Selectors of controls that are dimmed and receive no pointer events for a client without control.
    ".mantine-Slider-root, .mantine-InputWrapper-root, .mantine-NumberInput-root, .mantine-Checkbox-root, "
    "div:has(> button):has(+ div .mantine-Slider-root) > button, div:has(> button) + div:has(> button) > button"
)
VIEW_ONLY_STYLE = f"<style>{PARTS} :is({DIMMED}) {{ opacity: 0.45; pointer-events: none }}</style>"
"""Style rules for clients without control, who can only view."""

# Style sheet of the page; names in capitals are replaced by selectors.
RULES = """
:root { --w: min(62vw, calc((100vh - 10.5rem) * var(--aspect))); --low: max(29vh, 9rem); }
#PAGE { font-size: 0.8rem; line-height: 1.32; box-sizing: border-box; padding: 0.45rem 0.8rem;
  overflow-wrap: anywhere }
#PAGE p, #SAID p { margin: 0 0 0.3rem 0 }
#PAGE .legend { display: flex; flex-wrap: wrap; gap: 0.1rem 1rem; margin-bottom: 0.3rem }
#PAGE .legend span { display: inline-flex; align-items: center; gap: 0.4rem; white-space: nowrap }
#PAGE .dim, #SAID .dim { opacity: 0.62 }
#SAID { font-size: 0.88rem; line-height: 1.4; padding: 0 0.75rem 0.4rem; overflow-wrap: anywhere }
#SAID .stale { opacity: 0.5 }
#SAID .warn { color: #ff922b; font-weight: 600 }
#PAGE .number, #SAID .number { font-size: 1.25rem; font-weight: 600 }
#SAID table { border-collapse: collapse; font-size: 0.8rem; margin-bottom: 0.3rem }
#PAGE small { font-size: 0.8rem; margin-left: 0.8rem }
#SAID .cost { width: 100%; max-width: 26rem; display: block; font-size: 10.5px; fill: currentColor }
#SAID .cost path { stroke: currentColor; opacity: 0.2 }
#SAID .cost .best { font-weight: 700; fill: #4cf28c }
#SAID .more { color: #74c0fc; cursor: pointer; text-decoration: underline }
#SAID .details { display: none }
:root:has(DETAILS:checked) #SAID .details { display: block }
:root:has(DETAILS:focus-visible) #SAID .more { outline: 2px solid #fff }
#SAID td, #SAID th { padding: 0 0.9rem 0 0; text-align: left; font-weight: inherit }
.NOTE { font-size: 0.8rem; line-height: 1.4; padding: 0 0.75rem 0.4rem; overflow-wrap: anywhere }
PARTS .mantine-Flex-root:has(.mantine-Checkbox-root) > :first-child { width: auto !important; order: 1;
  padding-left: 0.6rem; flex: 1 }
PARTS .mantine-Flex-root:has(.mantine-Checkbox-root) p { color: #ddd }
PARTS .mantine-Flex-root:has(.mantine-Checkbox-root) > :last-child { flex: none !important }
.NOTE p { margin: 0 }
.NOTE ul { margin: 0; padding-left: 1.1rem }
#STATUS { position: fixed; top: 0; right: calc(100vw - var(--w)); z-index: 7; pointer-events: none }
#STATUS span { display: block; background: #e8590c; color: #fff; border-radius: 0 0 0 0.3rem; padding: 0.1rem 0.6rem;
  font-size: 0.9rem }
PANEL #PICTURE { position: fixed; left: 0; top: 0; width: var(--w); aspect-ratio: var(--aspect); background: #181818;
  z-index: 6 }
#PICTURE img { width: 100%; display: block }
NOTES { top: auto !important; bottom: 0.5rem; left: calc(var(--w) + 0.5rem) !important }
#ASIDE { position: fixed; left: var(--w); right: 0; bottom: 0; height: var(--low); z-index: 7; pointer-events: none;
  font-size: 0.8rem; display: flex; flex-wrap: wrap; align-content: flex-start; box-sizing: border-box }
#ASIDE > input { position: absolute; opacity: 0 }
#ASIDE > label, #ASIDE > button { pointer-events: auto; cursor: pointer; padding: 0.1rem 0.6rem; background: #2c2c2c;
  color: #ddd; border: 0; border-right: 1px solid #444; font: inherit; z-index: 1 }
#ASIDE > button { margin-left: auto }
#ASIDE > input:checked + label { background: #1971c2; color: #fff }
#ASIDE > input:focus-visible + label { outline: 2px solid #fff; outline-offset: -2px }
#ASIDE > .shown { display: none; position: absolute; inset: 1.5rem 0 0 0; background: #141414; pointer-events: auto;
  overflow: auto; padding: 0.2rem; box-sizing: border-box }
#ASIDE > input:nth-of-type(2):checked ~ .shown:nth-of-type(1),
#ASIDE > input:nth-of-type(3):checked ~ .shown:nth-of-type(2) { display: block }
:root.WITHOUT #ASIDE:has(> input:nth-of-type(1):checked)::after { width: 100%;
  content: "3-D view: not available, as this browser has no WebGL"; padding: 1rem; text-align: center; color: #ddd }
:root.WITHOUT canvas { visibility: hidden }
#ASIDE > .key { display: none; position: absolute; left: 0; bottom: 0; padding: 0 0.5rem;
  font-size: 0.72rem; background: #141414cc }
#ASIDE > input:nth-of-type(1):checked ~ .key { display: flex; flex-wrap: wrap; gap: 0 0.9rem }
#ASIDE p { margin: 0; font-size: 0.72rem; opacity: 0.75; line-height: 1.25 }
#SLICES img { display: block; width: 100%; max-width: calc(3 * (var(--low) - 3.9rem)); margin: 0 auto }
#HISTORY svg { display: block; width: 100%; height: calc(var(--low) - 2rem) }
#HISTORY text { fill: #ddd; font-size: 12px }
#HELP { pointer-events: auto; background: #2c2c2c; color: #eee; border: 1px solid #888; border-radius: 0.4rem;
  font-size: 0.95rem }
#HELP td { padding: 0.15rem 0.8rem 0.15rem 0 }
#HELP kbd { border: 1px solid #888; border-radius: 0.2rem; padding: 0 0.4rem }
#webgl-software-rendering { display: none }
:root:has(TABBED:checked) { --low: max(34vh, 13rem) }
#ASIDE:has(TABBED:checked) { background: #141414 }
@media (min-width: 36.01em) {
  PANEL { left: var(--w) !important; right: 0 !important; width: auto !important; bottom: var(--low) !important }
  PANEL > div:first-child, PANEL > div:last-child { display: none !important }
  PANEL > div > div { width: 100% !important }
  VIEW { inset: auto 0 0 var(--w) !important; height: var(--low); border-top: 1px solid #444 }
  #PAGE { position: fixed; left: 0; top: calc(var(--w) / var(--aspect)); width: var(--w); bottom: 0; overflow: auto;
    mask-image: linear-gradient(#000 calc(100% - 1.1rem), transparent); padding-bottom: 1.1rem }
}
@media (min-width: 75em) and (min-aspect-ratio: 13/10) {
  PARTS { display: grid; grid-template-columns: 1fr 1fr; grid-auto-flow: dense; align-items: center }
  PARTS > * { grid-column: 1 / -1 }
  PARTS > div:has(> button), PARTS > div:has(> .mantine-Flex-root) { grid-column: auto }
  PARTS > div:has(> button) + div:has(.mantine-Slider-root) { grid-column: 1 / -1 }
}
@media (min-width: 75em) and (min-aspect-ratio: 13/10) and (max-height: 50em) {
  :root { --low: max(17vh, 7.6rem) }
  #SAID { font-size: 0.8rem; line-height: 1.24 }
  #SAID p { margin-bottom: 0.15rem }
  #PAGE .number, #SAID .number { font-size: 1.1rem }
}
@media (min-width: 36.01em) and (max-aspect-ratio: 13/10) {
  :root { --low: max(25vh, 9rem) }
  :root:has(TABBED:checked) { --low: max(29vh, 13rem) }
  PANEL { bottom: 0 !important }
  VIEW { inset: auto calc(100vw - var(--w)) 0 0 !important }
  #PAGE { bottom: var(--low) }
  #ASIDE { left: 0; right: calc(100vw - var(--w)) }
  NOTES { left: 0.5rem !important }
}
@media (max-width: 74.99em) {
  #STATUS { top: calc(var(--w) / var(--aspect) - 3.6rem) }
}
@media (max-width: 36em) {
  :root { --w: 100vw; --low: 17vh }
  :root:has(TABBED:checked) { --low: max(25vh, 14rem) }
  PANEL { left: 0; top: calc(100vw / var(--aspect)); width: 100% !important; max-height: none !important;
    bottom: var(--low) !important }
  PANEL div[style*="20em"] { width: 100% !important }
  VIEW { position: absolute !important; inset: auto 0 0 0 !important; height: var(--low) !important }
  #PAGE { font-size: 0.78rem }
  #ASIDE { left: 0 }
  #STATUS span { font-size: 0.75rem }
  #SAID { font-size: 0.82rem }
  NOTES { left: 0.5rem !important }
}
@media (max-width: 36em) and (max-height: 50em) {
  #SAID { max-height: 11.4rem; overflow-y: auto;
    mask-image: linear-gradient(#000 calc(100% - 1.1rem), transparent); padding-bottom: 1.1rem }
}
"""


def build_style(aspect: float) -> str:
    """Return the HTML style element for an image with the given width / height `aspect`."""
    rules = RULES
    for name, value in (
        ("WITHOUT", NO_WEBGL_CLASS),
        ("#PICTURE", f"#{PICTURE}"),
        ("PANEL", PANEL),
        ("VIEW", VIEW),
        ("PARTS", PARTS),
        ("NOTES", NOTES),
        ("#PAGE", f"#{PAGE}"),
        ("#STATUS", f"#{STATUS}"),
        ("#SAID", f"#{SAID}"),
        ("#ASIDE", f"#{ASIDE}"),
        ("#SLICES", f"#{SLICES}"),
        ("#HISTORY", f"#{HISTORY}"),
        ("#HELP", f"#{HELP}"),
        ("DETAILS", f"#{DETAILS}"),
        ("TABBED", f":is({', '.join(f'#{name}' for _, name in TABS[1:])})"),
        (".NOTE", f".{NOTE}"),
    ):
        rules = rules.replace(name, value)
    return f"<style>:root {{ --aspect: {aspect:.4f} }}{rules}</style>"
