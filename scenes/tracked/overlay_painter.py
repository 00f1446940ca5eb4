"""Tumour overlay on a real image: reliable position in colour, last known position in grey, nothing when lost."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ar.optics.camera import Camera
from ar.overlay.composite import HEAD_WIDTHS, Overlaid, composite, write_header, write_warning
from ar.overlay.gauge import DistanceGauge
from ar.overlay.hud import format_bound, wrap_line
from ar.overlay.marks import BEFORE_COLOUR, BEFORE_STROKES, ImageText, Marks, Occluders
from ar.overlay.outlines import (
    average_colour,
    compute_silhouette,
    draw_dashes,
    find_outlines,
    find_pixel_box,
    join_boxes,
)
from ar.overlay.styles import MIN_REPORTED_SHARE, Opening, Style
from ar.rendering.layer import Layer
from ar.rendering.real_image import build_real_image

from ..play.player import measure_gauge
from ..play.stage import CORTEX, PREDICTED_LINES, TOOL, TOOL_COLOUR, Stage
from ..script.uncertainty import BOUND_DEVIATIONS
from .follower import TrackingResult, TumourState
from .tracked_tool import TrackedTool

NO_CONTACT_TEXT = "the tool does not touch: as in the scan"  # Text in the image.
SEEN_THROUGH = Opening((CORTEX,), (), "seen through bone or drape")
"""Layer through which the tumour is seen: the drape's hole; everything else may be bone."""
GREY_STATES = (TumourState.NO_TOOL, TumourState.STALE, TumourState.NO_REFERENCE)
"""States in which the tumour is drawn in grey, and dotted."""


@dataclass(frozen=True, eq=False)
class Painter:
    """Renderer of tracking results over images.

    Parameters
    ----------
    stage
        Stage with the brain to draw.
    tool
        Tool that occludes the tumour; None: no tool.
    style
        See `ar.overlay.composite.composite`.
    device
        Warp device.
    """

    stage: Stage
    tool: TrackedTool | None = None
    style: Style = "window"
    device: str = "cpu"

    def paint(self, colour: np.ndarray, known: TrackingResult, covered: np.ndarray | None = None) -> Overlaid:
        """Draw a tracking result on an image (H, W, 3) uint8.

        covered (H, W) bool marks foreground in front of the brain, such as a hand. Nothing is drawn over it, and the
        image
        shows the share of the tumour that it hides.
        """
        if known.state in GREY_STATES or known.camera is None:
            return self._draw_grey(colour, known, covered)
        camera, tumour = known.camera, self.stage.build_tumour(known.motion.positions)
        gauge = self.measure_tip(known, tumour)
        before = self.stage.tumour_at_rest if known.motion.known and known.motion.moved > 0.0 else None
        doubt = "" if known.relied else known.words
        band = 0.0 if known.band is None else known.band
        box = find_pixel_box(camera, tumour.vertices)
        if gauge is not None:
            box = join_boxes(box, find_pixel_box(camera, np.stack([gauge.tip, gauge.nearest_point])))
        layers = [] if box is None else self._build_layers(known)
        whole = slice(0, camera.height), slice(0, camera.width)
        picture = build_real_image(colour, camera, layers, box or whole, self.device)
        lines = [*format_head_lines(known), *self._describe_hidden(camera, tumour, covered)]
        head = [part for line in lines for part in wrap_line(line, HEAD_WIDTHS[0] * camera.width)]
        cover = Occluders((TOOL,), SEEN_THROUGH, covered)
        words = ImageText(doubt, head, PREDICTED_LINES, (known.motion.moved, known.motion.error), known.band)
        return composite(picture, camera, tumour, self.style, cover, Marks(band, gauge, before), words)

    def _describe_hidden(self, camera: Camera, tumour: Layer, covered: np.ndarray | None) -> Sequence[str]:
        """Describe the foreground's share of the tumour in the image, if it is noticeable."""
        box = find_pixel_box(camera, tumour.vertices)
        if covered is None or box is None or self.style == "none":
            return ()
        mask = compute_silhouette(camera.crop_to(*box), tumour.vertices, tumour.triangles)
        hidden = np.count_nonzero(mask & covered[box])
        share = hidden / max(np.count_nonzero(mask), 1)
        return (f"{share:.0%} of the tumour is behind what lies in front",) if share >= MIN_REPORTED_SHARE else ()

    def _build_layers(self, known: TrackingResult) -> list[Layer]:
        """Build the layers to render: open cortex above the tumour, drape around it as in videos, and tool."""
        tool = self.build_tool_layer(known)
        return [*self.stage.build_layers(known.motion.positions, None), *([] if tool is None else [tool])]

    def build_tool_layer(self, known: TrackingResult, cubed: bool = True) -> Layer | None:
        """Return the tool's surface if its pose is available, with or without its cube."""
        pose = known.T_scan_tool
        if self.tool is None or pose is None:
            return None
        return Layer("tool", TOOL, *self.tool.build_surface(pose, cubed), TOOL_COLOUR)

    def measure_tip(self, known: TrackingResult, tumour: Layer) -> DistanceGauge | None:
        """Measure from the tool's tip to the tumour, with the error of both; None if a position is unknown."""
        if known.T_scan_tool is None or known.tip_covariance is None or known.band is None:
            return None
        gauge = measure_gauge(known.T_scan_tool[:3, 3], tumour)
        along = (gauge.nearest_point - gauge.tip) / max(gauge.distance, np.finfo(float).tiny)
        spread = BOUND_DEVIATIONS * float(np.sqrt(along @ known.tip_covariance @ along))
        return DistanceGauge(gauge.tip, gauge.nearest_point, error=float(np.hypot(spread, known.motion.error)))

    def _draw_grey(self, colour: np.ndarray, known: TrackingResult, covered: np.ndarray | None) -> Overlaid:
        """Draw the outline in grey at the last position, if there is one, with the reason."""
        over = Overlaid(colour.copy(), np.zeros(colour.shape[:2], np.uint8))
        if known.camera is not None and self.style != "none":
            self._draw_dotted(over, known.camera, self.stage.build_tumour(known.motion.positions))
            if covered is not None:
                over.colour[covered] = colour[covered]
        write_header(over, [])
        write_warning(over, known.words)
        return over

    def _draw_dotted(self, over: Overlaid, camera: Camera, tumour: Layer) -> None:
        box = find_pixel_box(camera, tumour.vertices)
        if box is None:
            return
        mask = compute_silhouette(camera.crop_to(*box), tumour.vertices, tumour.triangles)
        draw_dashes(over.colour[box], find_outlines(mask), average_colour(BEFORE_COLOUR), BEFORE_STROKES)


def format_head_lines(known: TrackingResult) -> Sequence[str]:
    """Describe the tumour position and its error, for the top of the image."""
    if known.band is None:
        return ()
    largest = max(known.parts, key=lambda name: known.parts[name])
    lines = [NO_CONTACT_TEXT] if known.state is TumourState.REST else []
    if known.relied:
        lines.append(f"overlay error <= {format_bound(known.band, 1)} across the view (95 %), mainly {largest}")
    motion = "; of motion: not known" if not known.motion.known else ""
    camera = "" if "camera" in known.parts else ", camera"
    return (*lines, f"error by tissue{camera} and segmentation: not known{motion}")
