"""Text of an overlay's page (HTML): state of the overlay, reasons for unreliable results, and errors."""

from html import escape

from ar.overlay.composite import DOUBTFUL_COLOUR
from ar.overlay.gauge import DistanceGauge
from ar.overlay.hud import format_bound

from ..page.text import RESEARCH_ONLY, format_legend, format_length, format_tip_distance, to_svg_stroke
from ..play.stage import TUMOUR_COLOUR
from .follower import TrackingResult, TumourState
from .run import Overlay

PATIENT_ERROR = "<p>Tumour position error: not known. Tissue and segmentation add to the overlay error.</p>"
STATE_TEXTS = {  # Texts on the page, by the state of the tumour.
    TumourState.GOOD: "The tumour is drawn where it is now.",
    TumourState.REST: "The tumour is drawn as in the scan, for the tool does not touch.",
}


def describe_overlay(name: str, model: str, has_tool: bool) -> str:
    """Build the caption (HTML) of the page: source `name` of the images, legend of the lines, deformation `model`."""
    now, doubt = to_svg_stroke(TUMOUR_COLOUR), to_svg_stroke(DOUBTFUL_COLOUR)
    keys = [
        (f'{now} stroke-width="3"', "tumour now"),
        (f'{now} stroke-width="3" stroke-dasharray="5 3"', "hidden by tool, drape or bone"),
        (f'{now} stroke-width="1.5" stroke-dasharray="4 3"', "95 % error band"),
        ('stroke="#ddd" stroke-width="2" stroke-dasharray="1.5 3"', "tumour in the scan; lost or stale: where it was"),
        (f'{doubt} stroke-width="3" stroke-dasharray="5 3"', "not to be relied on"),
        *([('stroke="#fff" stroke-width="1.5"', "tip to tumour, in mm")] if has_tool else []),
    ]
    seen = (
        f"What you see: {escape(name)}, with the tumour drawn into it that is hidden under the cortex. Reference and "
        "tool are tracked in each image."
    )
    return (
        f"<p>{seen} <b>{RESEARCH_ONLY}</b></p>{format_legend(keys)}<p>Motion of the brain by {escape(model)}.</p>"
        '<p class="dim">A scene in its place: <code>sulcus demo</code>.</p>'
    )


def format_report(overlay: Overlay, tip_gauge: DistanceGauge | None, has_tool: bool, image_name: str) -> str:
    """Build the report (HTML) of an image: distance from tip to tumour, state, errors, and processing time.

    `image_name` is the description of the image.
    """
    seen = overlay.result
    parts = [format_distance(tip_gauge, seen.is_reliable)] if has_tool else []
    doubt = f'<p class="warn">{escape(seen.warning)}</p>'
    parts.append(f"<p><b>{STATE_TEXTS[seen.state]}</b></p>" if seen.is_reliable else doubt)
    parts += [format_overlay_error(seen), PATIENT_ERROR]
    placed = seen.reference_time == seen.time
    tool = "seen" if seen.T_scan_tool is not None else "not seen" if placed else "not placed without the reference"
    facts = [image_name, f"reference {'seen' if placed else 'not seen'}", *([f"tool {tool}"] if has_tool else [])]
    if seen.motion.supported and seen.is_reliable:
        facts.append(f"tumour moved {format_length(seen.motion.distance, seen.motion.error)} (error of model and tool)")
    took = f"looked at and drawn in {1e3 * overlay.seconds:.0f} ms"
    if overlay.latency is not None:
        took += f"; shown {1e3 * overlay.latency:.0f} ms after it was taken"
    return "".join([*parts, f"<p>{'; '.join(facts)}</p>", f'<p class="dim">{took}</p>'])


def format_distance(tip_gauge: DistanceGauge | None, is_reliable: bool) -> str:
    """Format the distance from tip to tumour (HTML), with its error if the position is reliable."""
    if tip_gauge is None:
        return '<p class="number">tip to tumour: not known</p>'
    return format_tip_distance(tip_gauge.distance, tip_gauge.error if is_reliable else None, tip_gauge.is_inside)


def format_overlay_error(tracking: TrackingResult) -> str:
    """Describe (HTML) the error bound of the outline across the line of sight, with its contributions by source."""
    if not tracking.is_reliable or tracking.bound is None:
        return "<p>Overlay error: not known.</p>"
    stated = [f"{name} {format_bound(length, 2)}" for name, length in tracking.sources.items() if length > 0.0]
    none = ", ".join(name for name, length in tracking.sources.items() if not length > 0.0 and name != "camera")
    off = tracking.sources.get("camera")
    camera = " What the camera's calibration adds is not known." if off is None else ""
    camera = " The camera is reported to be exactly known." if off == 0.0 else camera
    parts = ", ".join([*stated, *([f"not given: {none}"] if none else [])])
    return f"<p>Overlay error (95 %): at most {format_bound(tracking.bound, 1)} across the view ({parts}).{camera}</p>"
