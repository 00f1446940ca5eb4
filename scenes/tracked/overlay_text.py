"""Text of an overlay's page, as HTML: overlay state, reasons of unreliable results, and both errors."""

from html import escape

from ar.overlay.composite import DOUBTFUL_COLOUR
from ar.overlay.gauge import DistanceGauge
from ar.overlay.hud import format_bound

from ..page.text import RESEARCH_ONLY, format_legend, format_tip_distance, format_unbroken, to_stroke
from ..play.stage import TUMOUR_COLOUR
from .follower import TrackingResult, TumourState
from .run import Shown

PATIENT_ERROR = "<p>Tumour position error: not known. Tissue and segmentation add to the overlay error.</p>"
STATE_TEXTS = {  # Texts on the page, by the state of the tumour.
    TumourState.GOOD: "The tumour is drawn where it is now.",
    TumourState.REST: "The tumour is drawn as in the scan, for the tool does not touch.",
}


def describe_overlay(name: str, who: str, tooled: bool) -> str:
    """Describe the image: its source, the meaning of the lines, and the deformation model."""
    now, doubt = to_stroke(TUMOUR_COLOUR), to_stroke(DOUBTFUL_COLOUR)
    keys = [
        (f'{now} stroke-width="3"', "tumour now"),
        (f'{now} stroke-width="3" stroke-dasharray="5 3"', "hidden by tool, drape or bone"),
        (f'{now} stroke-width="1.5" stroke-dasharray="4 3"', "95 % error band"),
        ('stroke="#ddd" stroke-width="2" stroke-dasharray="1.5 3"', "tumour in the scan; lost or stale: where it was"),
        (f'{doubt} stroke-width="3" stroke-dasharray="5 3"', "not to be relied on"),
        *([('stroke="#fff" stroke-width="1.5"', "tip to tumour, in mm")] if tooled else []),
    ]
    seen = (
        f"What you see: {escape(name)}, with the tumour drawn into it that is hidden under the cortex. Reference and "
        "tool are tracked in each image."
    )
    return (
        f"<p>{seen} <b>{RESEARCH_ONLY}</b></p>{format_legend(keys)}<p>Motion of the brain by {escape(who)}.</p>"
        '<p class="dim">A scene in its place: <code>sulcus demo</code>.</p>'
    )


def report(shown: Shown, gauge: DistanceGauge | None, tooled: bool, place: str) -> str:
    """Build the report of an image: distance first, then state, both errors, and processing time.

    `place` names the image.
    """
    known = shown.known
    parts = [format_distance(gauge, known.relied)] if tooled else []
    doubt = f'<p class="warn">{escape(known.words)}</p>'
    parts.append(f"<p><b>{STATE_TEXTS[known.state]}</b></p>" if known.relied else doubt)
    parts += [overlay_error(known), PATIENT_ERROR]
    placed = known.reference_time == known.time
    tool = "seen" if known.T_scan_tool is not None else "not seen" if placed else "not placed without the reference"
    facts = [place, f"reference {'seen' if placed else 'not seen'}", *([f"tool {tool}"] if tooled else [])]
    if known.motion.known and known.relied:
        facts.append(
            f"tumour moved {format_unbroken(known.motion.moved, known.motion.error)} (error of model and tool)"
        )
    took = f"looked at and drawn in {1e3 * shown.seconds:.0f} ms"
    if shown.latency is not None:
        took += f"; shown {1e3 * shown.latency:.0f} ms after it was taken"
    return "".join([*parts, f"<p>{'; '.join(facts)}</p>", f'<p class="dim">{took}</p>'])


def format_distance(gauge: DistanceGauge | None, relied: bool) -> str:
    """Return the distance from tip to tumour with its error, where there is one that may be relied on."""
    if gauge is None:
        return '<p class="number">tip to tumour: not known</p>'
    return format_tip_distance(gauge.distance, gauge.error if relied else None, gauge.is_inside)


def overlay_error(known: TrackingResult) -> str:
    """Describe the error of the outline across the view, by source."""
    if not known.relied or known.band is None:
        return "<p>Overlay error: not known.</p>"
    stated = [f"{name} {format_bound(length, 2)}" for name, length in known.parts.items() if length > 0.0]
    none = ", ".join(name for name, length in known.parts.items() if not length > 0.0 and name != "camera")
    off = known.parts.get("camera")
    camera = " What the camera's calibration adds is not known." if off is None else ""
    camera = " The camera is reported to be exactly known." if off == 0.0 else camera
    parts = ", ".join([*stated, *([f"not given: {none}"] if none else [])])
    return f"<p>Overlay error (95 %): at most {format_bound(known.band, 1)} across the view ({parts}).{camera}</p>"
