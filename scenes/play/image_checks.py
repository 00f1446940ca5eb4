"""Detection of a frame's overlay in its pixels: outline, numbers, and parts under drape or bone."""

import numpy as np

from ar.optics.camera import Camera
from ar.overlay.composite import BROKEN_STROKES, DOUBTFUL_COLOUR, HIDDEN_STROKES, wrap_label
from ar.overlay.gauge import NUMBER_SCALE, format_tip_distance
from ar.overlay.hud import MAX_BOTTOM_WIDTH, TEXT_SCALE, WHITE, format_millimetres, wrap_line
from ar.overlay.outlines import (
    average_colour,
    compute_changed_share,
    compute_drawn_share,
    find_colour,
    find_text,
    has_text,
    measure_outline_distance,
)
from ar.overlay.styles import MIN_REPORTED_SHARE, WHOLE_SHARE
from ar.rendering.layer import Layer
from ar.rendering.raycast import raycast
from sim.geometry.surface import is_enclosing
from surrogate.locating.prior import compute_centroid_motion
from surrogate.model.guarded import find_first_model

from .frame_text import label_frame
from .player import TRUE_STROKES, Frame, Player
from .stage import ESTIMATED_LINES, OPENING, TOOL, TRUTH_COLOUR, TUMOUR_COLOUR

EDGE_STEPS = 24  # Number of sampling steps along an edge of a triangle of the tumour.
# Barycentric weights (q, 3) at which the tumour's triangles are sampled: corners, edges and interior.
SAMPLES = (
    np.array([(i, j, EDGE_STEPS - i - j) for i in range(EDGE_STEPS + 1) for j in range(EDGE_STEPS + 1 - i)])
    / EDGE_STEPS
)

MASK_TOLERANCE = 0.02  # Share of the silhouette's pixels that may deviate.
BROKEN_SHARES = (0.35, 0.88)  # Range of the share of a broken outline that is drawn.
MAX_CHANGED_SHARE = 0.5  # Largest share of occluded ground whose colour may change.
SOFT_LENGTH = 2  # Total length of the soft ends of two strokes [pixel]: their colour is not the outline's.
MAX_NUMBER_DISTANCE = 0.35  # Largest distance of the number from the tip, as a share of the image width.


def render_silhouette(camera: Camera, layer: Layer) -> np.ndarray:
    """Compute the mask (H, W) bool of pixels that a surface covers, with the independent ray caster."""
    return raycast(camera, layer.vertices, layer.triangles).mask


def measure_outline_error(frame: Frame, mask: np.ndarray) -> float:
    """Compute the distance [pixel] between the outline in a frame's image and that of a silhouette mask (H, W) bool.

    A broken outline, which marks an occluded tumour or an unreliable solution, may have gaps.
    """
    ink, shut = average_colour(DOUBTFUL_COLOUR if frame.doubt else TUMOUR_COLOUR), mask_covered_pixels(frame)
    above = _mask_foreground(frame)
    gap = BROKEN_STROKES[1] + SOFT_LENGTH if frame.doubt else 0
    return max(
        measure_outline_distance(frame.shown, ink, mask, above | shut, gap_length=gap),
        measure_outline_distance(
            frame.shown, ink, mask, above | ~shut, sum(HIDDEN_STROKES), HIDDEN_STROKES[1] + SOFT_LENGTH
        ),
    )


def measure_true_outline_error(frame: Frame, mask: np.ndarray) -> float:
    """Compute the distance [pixel] of the FEM tumour's drawn outline from a mask's; ignore the estimate's outline."""
    above = _mask_foreground(frame) | find_colour(frame.shown, average_colour(TUMOUR_COLOUR))
    return measure_outline_distance(frame.shown, average_colour(TRUTH_COLOUR), mask, above, 2 * sum(TRUE_STROKES))


def _mask_foreground(frame: Frame) -> np.ndarray:
    """Return the mask (H, W) bool of pixels with text or a tool."""
    return find_colour(frame.shown, WHITE, 0) | (frame.picture.segmentation == TOOL)


def mask_covered_pixels(frame: Frame) -> np.ndarray:
    """Return the mask (H, W) bool of pixels that show neither a tool nor the open cortex above the tumour."""
    return ~np.isin(frame.picture.segmentation, (*OPENING.ids, TOOL))


def has_hidden_mark(frame: Frame, mask: np.ndarray) -> bool:
    """Return True if the image marks the occluded part of a silhouette (H, W) bool, or if no part is occluded.

    In the occluded part, the outline must be broken and not shaded, and the image must name the occluder.
    """
    ink, shut = average_colour(DOUBTFUL_COLOUR if frame.doubt else TUMOUR_COLOUR), mask_covered_pixels(frame)
    least, most = BROKEN_SHARES
    inked = compute_drawn_share(frame.shown, ink, mask, _mask_foreground(frame) | ~shut)
    changed = compute_changed_share(frame.picture.colour, frame.shown, mask & shut & (frame.taken == 0))
    return _is_ground_labelled(frame, mask) and not (
        inked < least or inked > most or changed > MAX_CHANGED_SHARE
    )  # NaN: none is there


def _is_ground_labelled(frame: Frame, mask: np.ndarray) -> bool:
    seen = frame.picture.segmentation[mask & (frame.picture.segmentation != TOOL)]
    layers, counts = (each.tolist() for each in np.unique(seen, return_counts=True))
    share = float(np.isin(seen, OPENING.ids, invert=True).mean()) if len(seen) else 0.0
    if share < MIN_REPORTED_SHARE + MASK_TOLERANCE:
        return True
    words = OPENING.describe(dict(zip(layers, counts, strict=True))).removeprefix("partly ")
    allowed = [words] * (share > WHOLE_SHARE - MASK_TOLERANCE) + [f"partly {words}"] * (
        share < WHOLE_SHARE + MASK_TOLERANCE
    )
    return any(all(has_text(frame.shown, line, TEXT_SCALE) for line in wrap_label(text)) for text in allowed)


def has_printed_numbers(player: Player, frame: Frame) -> bool:
    """Return True if the image shows the frame number, the distance from tip to tumour, and the estimate."""
    labelled = all(has_text(frame.shown, line, TEXT_SCALE) for line in label_frame(frame.number))
    if not labelled or not _has_printed_estimate(player, frame):
        return False
    return frame.tip is None or _find_number(player, frame, frame.tip) is not None


def has_distance_at_tip(player: Player, frame: Frame) -> bool:
    """Return True if the distance text is visible near the tip, or near the border if the tip is outside the image."""
    if frame.tip is None:
        return True
    (tip,), _ = frame.camera.project(frame.tip[None])
    found = _find_number(player, frame, frame.tip)
    if found is None or not np.isfinite(tip).all():
        return found is not None
    height, width = frame.shown.shape[:2]
    tip = np.clip(tip, 0, (width - 1, height - 1))
    away = tip - np.clip(tip, found[:2], found[2:])
    return bool(np.linalg.norm(away) <= MAX_NUMBER_DISTANCE * width)


def _find_number(player: Player, frame: Frame, tip: np.ndarray) -> tuple[int, int, int, int] | None:
    """Find the bounding box of the distance text in an image; None if the text is not found."""
    corners = _get_corners(player, frame)
    distance, inside = _compute_distance(player, frame, corners, tip), is_enclosing(corners, tip)
    error = None if frame.doubt else frame.tumour_error.bound
    for off in (0.0, 0.5e-4, 1e-4):  # samples are never nearer than the surface: by less than what is printed
        text = format_tip_distance(distance - off, error, inside)
        at = find_text(frame.shown, text, NUMBER_SCALE)
        if at is not None:
            return at
    return None


def _has_printed_estimate(player: Player, frame: Frame) -> bool:
    """Return True if the image shows the estimated tumour motion and its error, or if there is no estimate."""
    found = frame.estimate
    if found is None or found.location is None:
        return True
    anatomy, rest = player.site.anatomy, player.site.anatomy.mesh.nodes
    true, moved = compute_centroid_motion(
        anatomy, np.stack([player.compute_positions(frame.deformation) - rest, player.estimate_positions(frame) - rest])
    )
    off, length = float(np.linalg.norm(moved - true)), float(np.linalg.norm(moved))
    lines = [
        line
        for text in (f"{ESTIMATED_LINES.motion} {format_millimetres(length, found.location.p95)}", frame.remark)
        for line in wrap_line(text, MAX_BOTTOM_WIDTH * frame.shown.shape[1])
    ]
    return frame.remark.endswith(f"error {1e3 * off:.1f} mm") and all(
        has_text(frame.shown, text, TEXT_SCALE) for text in lines
    )


def _get_corners(player: Player, frame: Frame) -> np.ndarray:
    """Return the corners (S, 3, 3) [m] of the drawn tumour's triangles."""
    return player.estimate_positions(frame)[player.stage.select_stage(frame.loads).anatomy.tumour_surface]


def _compute_distance(player: Player, frame: Frame, corners: np.ndarray, tip: np.ndarray) -> float:
    """Compute the distance from tip to tumour [m] by sampling the drawn surface; a trained model corrects the value."""
    apart = float(np.linalg.norm(np.einsum("qc,scx->sqx", SAMPLES, corners) - tip, axis=2).min())
    model = find_first_model(player.deformer, frame.deformation)
    if model is None:
        return apart
    return float(model.predict_distance(frame.loads, frame.deformation, np.array([apart])).distance[0])
