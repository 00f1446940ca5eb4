"""Side panels of an overlay page's 3-D view: slices of the scan, and recent readings."""

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


def list_lines(tooled: bool) -> tuple[Trace, ...]:
    """Return the plotted quantities of each image."""
    return (DISTANCE, OVERLAY_ERROR) if tooled else (OVERLAY_ERROR,)


def build_history_sample(known: TrackingResult, gauge: DistanceGauge | None, tooled: bool, now: float) -> Sample:
    """Build the readings of an image that is shown at a time [s], in the order of `list_lines`."""
    within = 1e3 * known.band if known.relied and known.band is not None else None
    if not tooled:
        return Sample(now, (within,), (0.0,))
    distance = None if gauge is None else 1e3 * gauge.distance
    error = 1e3 * gauge.error if gauge is not None and gauge.error is not None and known.relied else None
    return Sample(now, (distance, within), (error, 0.0))


def render_slices(known: TrackingResult, painter: Painter, through: str) -> np.ndarray:
    """Render three slices (h, 3 h, 3) uint8 of the scan, through one of the places of `scenes.page.side_panels`.

    The error band is that of the motion: tracking and registration do not move the tumour in the scan.
    """
    stage, tool = painter.stage, painter.build_tool_layer(known, cubed=False)
    tip = None if known.T_scan_tool is None else known.T_scan_tool[:3, 3]
    others = [] if tool is None else [tool]
    error = known.motion.error if known.relied and known.motion.known else None
    now = stage.build_tumour(known.motion.positions)
    return draw_slices_through(
        stage, SlicedSurfaces(now, stage.tumour_at_rest, error, not known.relied, others, tip, "motion"), through
    )
