"""Tumour overlay on a real image: reliable positions in colour, last known positions in grey."""

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

from ..play.player import measure_tip_gauge
from ..play.stage import CORTEX, PREDICTED_LINES, TOOL, TOOL_COLOUR, Stage
from ..script.uncertainty import BOUND_DEVIATIONS
from .follower import TrackingResult, TumourState
from .tracked_tool import TrackedTool

NO_CONTACT_TEXT = "the tool does not touch: as in the scan"  # Text in the image.
SEEN_THROUGH = Opening((CORTEX,), (), "seen through bone or drape")
"""Layer under which the tumour is drawn as visible: the cortex in the drape's hole; elsewhere bone may hide it."""
GREY_STATES = (TumourState.NO_TOOL, TumourState.STALE, TumourState.NO_REFERENCE)
"""States in which the tumour is drawn as a grey dotted outline."""


@dataclass(frozen=True, eq=False)
class Painter:
    """Renderer that draws tracking results on images.

    Parameters
    ----------
    stage
        Rendered parts of the brain.
    tool
        Tracked tool, which may occlude the tumour; None: no tool.
    style
        Overlay style, see `ar.overlay.composite.composite`.
    device
        Warp device for rendering.
    """

    stage: Stage
    tool: TrackedTool | None = None
    style: Style = "window"
    device: str = "cpu"

    def paint(self, image: np.ndarray, tracking: TrackingResult, occlusion_mask: np.ndarray | None = None) -> Overlaid:
        """Draw a tracking result on an image (H, W, 3) uint8, and return the composite image.

        `occlusion_mask` (H, W) bool marks foreground in front of the brain, such as a hand. Nothing is drawn on the
        foreground, and a text line in the image reports the share of the tumour that the foreground hides.
        """
        if tracking.state in GREY_STATES or tracking.camera is None:
            return self._draw_grey(image, tracking, occlusion_mask)
        camera, tumour = tracking.camera, self.stage.build_tumour(tracking.motion.positions)
        gauge = self.measure_tip_distance(tracking, tumour)
        before = self.stage.tumour_at_rest if tracking.motion.supported and tracking.motion.distance > 0.0 else None
        doubt = "" if tracking.is_reliable else tracking.warning
        band = 0.0 if tracking.bound is None else tracking.bound
        box = find_pixel_box(camera, tumour.vertices)
        if gauge is not None:
            box = join_boxes(box, find_pixel_box(camera, np.stack([gauge.tip, gauge.nearest_point])))
        layers = [] if box is None else self._build_layers(tracking)
        whole = slice(0, camera.height), slice(0, camera.width)
        picture = build_real_image(image, camera, layers, box or whole, self.device)
        lines = [*format_top_lines(tracking), *self._describe_hidden(camera, tumour, occlusion_mask)]
        head = [part for line in lines for part in wrap_line(line, HEAD_WIDTHS[0] * camera.width)]
        cover = Occluders((TOOL,), SEEN_THROUGH, occlusion_mask)
        words = ImageText(
            doubt, head, PREDICTED_LINES, (tracking.motion.distance, tracking.motion.error), tracking.bound
        )
        return composite(picture, camera, tumour, self.style, cover, Marks(band, gauge, before), words)

    def _describe_hidden(self, camera: Camera, tumour: Layer, occlusion_mask: np.ndarray | None) -> Sequence[str]:
        """Describe the share of the tumour that the foreground hides; empty if the share is negligible."""
        box = find_pixel_box(camera, tumour.vertices)
        if occlusion_mask is None or box is None or self.style == "none":
            return ()
        mask = compute_silhouette(camera.crop_to(*box), tumour.vertices, tumour.triangles)
        hidden = np.count_nonzero(mask & occlusion_mask[box])
        share = hidden / max(np.count_nonzero(mask), 1)
        return (f"{share:.0%} of the tumour is behind what lies in front",) if share >= MIN_REPORTED_SHARE else ()

    def _build_layers(self, tracking: TrackingResult) -> list[Layer]:
        """Build the layers to render: open cortex, drape around the craniotomy, and tool if its pose is available."""
        tool = self.build_tool_layer(tracking)
        return [*self.stage.build_layers(tracking.motion.positions, None), *([] if tool is None else [tool])]

    def build_tool_layer(self, tracking: TrackingResult, with_cube: bool = True) -> Layer | None:
        """Return the tool's surface, with its marker cube if `with_cube`; None if the pose is not available."""
        pose = tracking.T_scan_tool
        if self.tool is None or pose is None:
            return None
        return Layer("tool", TOOL, *self.tool.build_surface(pose, with_cube), TOOL_COLOUR)

    def measure_tip_distance(self, tracking: TrackingResult, tumour: Layer) -> DistanceGauge | None:
        """Measure the distance from tip to tumour, with its error bound; None if the error of either is unknown."""
        if tracking.T_scan_tool is None or tracking.tip_covariance is None or tracking.bound is None:
            return None
        gauge = measure_tip_gauge(tracking.T_scan_tool[:3, 3], tumour)
        along = (gauge.nearest_point - gauge.tip) / max(gauge.distance, np.finfo(float).tiny)
        spread = BOUND_DEVIATIONS * float(np.sqrt(along @ tracking.tip_covariance @ along))
        return DistanceGauge(gauge.tip, gauge.nearest_point, error=float(np.hypot(spread, tracking.motion.error)))

    def _draw_grey(self, colour: np.ndarray, tracking: TrackingResult, occlusion_mask: np.ndarray | None) -> Overlaid:
        """Draw the warning and, if a camera pose is available, a grey outline at the last tumour position."""
        over = Overlaid(colour.copy(), np.zeros(colour.shape[:2], np.uint8))
        if tracking.camera is not None and self.style != "none":
            self._draw_dotted(over, tracking.camera, self.stage.build_tumour(tracking.motion.positions))
            if occlusion_mask is not None:
                over.colour[occlusion_mask] = colour[occlusion_mask]
        write_header(over, [])
        write_warning(over, tracking.warning)
        return over

    def _draw_dotted(self, overlaid: Overlaid, camera: Camera, tumour: Layer) -> None:
        box = find_pixel_box(camera, tumour.vertices)
        if box is None:
            return
        mask = compute_silhouette(camera.crop_to(*box), tumour.vertices, tumour.triangles)
        draw_dashes(overlaid.colour[box], find_outlines(mask), average_colour(BEFORE_COLOUR), BEFORE_STROKES)


def format_top_lines(tracking: TrackingResult) -> Sequence[str]:
    """Describe the tumour's state and overlay error, as lines for the top of the image; empty without a bound."""
    if tracking.bound is None:
        return ()
    largest = max(tracking.sources, key=lambda name: tracking.sources[name])
    lines = [NO_CONTACT_TEXT] if tracking.state is TumourState.REST else []
    if tracking.is_reliable:
        lines.append(f"overlay error <= {format_bound(tracking.bound, 1)} across the view (95 %), mainly {largest}")
    motion = "; of motion: not known" if not tracking.motion.supported else ""
    camera = "" if "camera" in tracking.sources else ", camera"
    return (*lines, f"error by tissue{camera} and segmentation: not known{motion}")
