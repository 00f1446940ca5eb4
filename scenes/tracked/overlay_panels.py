"""Side panels of an overlay page's 3-D view: slices of the scan, and charts of recent values."""

import numpy as np

from ar.overlay.gauge import DistanceGauge
from ar.page.history import Sample, Trace
from ar.page.slices import SlicedSurfaces

from ..page.side_panels import draw_slices_through
from .follower import TrackingResult
from .overlay_painter import Painter

# Chart of the distance from tip to tumour.
DISTANCE = Trace("tip to tumour", "mm", "#f4f4f0", "band: error of tip and motion (95 %); dotted: not to be relied on")
# Chart of the overlay's error.
OVERLAY_ERROR = Trace(
    "error of the overlay", "mm", "#4cf28c", "across the view (95 %), without tissue and segmentation"
)


def list_plot_lines(has_tool: bool) -> tuple[Trace, ...]:
    """Return the plotted quantities: distance from tip to tumour (if there is a tool), and overlay error."""
    return (DISTANCE, OVERLAY_ERROR) if has_tool else (OVERLAY_ERROR,)


def build_history_sample(tracking: TrackingResult, gauge: DistanceGauge | None, has_tool: bool, time: float) -> Sample:
    """Build the plotted values of an image that is shown at a time [s], in the order of `list_plot_lines`."""
    within = 1e3 * tracking.bound if tracking.is_reliable and tracking.bound is not None else None
    if not has_tool:
        return Sample(time, (within,), (0.0,))
    distance = None if gauge is None else 1e3 * gauge.distance
    error = 1e3 * gauge.error if gauge is not None and gauge.error is not None and tracking.is_reliable else None
    return Sample(time, (distance, within), (error, 0.0))


def render_slices(tracking: TrackingResult, painter: Painter, position: str) -> np.ndarray:
    """Render three slices (h, 3 h, 3) uint8 of the scan through `position`, a label in `scenes.page.side_panels`.

    The error band shows the error of the motion only: tracking and registration do not move the tumour in the scan.
    """
    stage, tool = painter.stage, painter.build_tool_layer(tracking, with_cube=False)
    tip = None if tracking.T_scan_tool is None else tracking.T_scan_tool[:3, 3]
    others = [] if tool is None else [tool]
    error = tracking.motion.error if tracking.is_reliable and tracking.motion.supported else None
    now = stage.build_tumour(tracking.motion.positions)
    return draw_slices_through(
        stage,
        SlicedSurfaces(now, stage.tumour_at_rest, error, not tracking.is_reliable, others, tip, "motion"),
        position,
    )
