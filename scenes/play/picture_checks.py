"""Detection of a frame's overlay in its pixels: outline, numbers, and parts that are not seen through cortex."""

from __future__ import annotations

import numpy as np

from ar.optics.camera import Camera
from ar.overlay.composite import BROKEN, DOUBTFUL, HIDDEN, ground_lines
from ar.overlay.gauge import GAUGE, gauge_words
from ar.overlay.hud import FINE, NARROW, WHITE, folded, millimetres
from ar.overlay.outlines import changed_share, found_at, ink_of, inked_share, of_ink, outline_gap, stands
from ar.overlay.styles import NOTICED, WHOLE
from ar.rendering.layer import Layer
from ar.rendering.raycast import raycast
from sim.geometry.surface import encloses
from surrogate.locating.prior import middle_of
from surrogate.model.guarded import answering

from .player import TRUE_STROKES, Frame, Player
from .stage import ESTIMATED_LINES, OPENING, TOOL, TRUTH_COLOUR, TUMOUR_COLOUR

# Barycentric weights (q, 3) at which the tumour's triangles are sampled: corners, edges and insides.
STEPS = 24
SAMPLES = np.array([(i, j, STEPS - i - j) for i in range(STEPS + 1) for j in range(STEPS + 1 - i)]) / STEPS

# # Share of the silhouette's pixels that may deviate.
SLACK = 0.02
# # Range of the ink share of a broken outline; largest changed share of occluded ground.
BROKEN_SHARES, CHANGED = (0.35, 0.88), 0.5
# The soft ends of two strokes [pixel]: their ink is not the outline's.
SOFT = 2
# # Largest distance of the number from the tip, as a share of the image width.
FAR = 0.3


def silhouette_of(camera: Camera, layer: Layer) -> np.ndarray:
    """Compute the pixels (H, W) bool that a surface covers, by the independent renderer."""
    return raycast(camera, layer.vertices, layer.triangles).mask


def drawn_off(frame: Frame, mask: np.ndarray) -> float:
    """Compute the distance between the outline in a frame's image and that of a silhouette (H, W) bool [pixel].

    Outlines drawn broken, because they are occluded or unreliable, may have gaps.
    """
    ink, shut = ink_of(DOUBTFUL if frame.doubt else TUMOUR_COLOUR), closed(frame)
    above = _above(frame)
    gap = BROKEN[1] + SOFT if frame.doubt else 0
    return max(
        outline_gap(frame.shown, ink, mask, above | shut, gap=gap),
        outline_gap(frame.shown, ink, mask, above | ~shut, sum(HIDDEN), HIDDEN[1] + SOFT),
    )


def truth_off(frame: Frame, mask: np.ndarray) -> float:
    """Compute the distance of the truth's outline [pixel]; the estimate's outline, drawn over it, is masked out."""
    above = _above(frame) | of_ink(frame.shown, ink_of(TUMOUR_COLOUR))
    return outline_gap(frame.shown, ink_of(TRUTH_COLOUR), mask, above, 2 * sum(TRUE_STROKES))


def _above(frame: Frame) -> np.ndarray:
    """(H, W) bool: words and tools."""
    return of_ink(frame.shown, WHITE, 0) | (frame.picture.segmentation == TOOL)


def closed(frame: Frame) -> np.ndarray:
    """(H, W) bool: ground that the tumour is not seen through, and no tool."""
    return ~np.isin(frame.picture.segmentation, (*OPENING.ids, TOOL))


def honest(frame: Frame, mask: np.ndarray) -> bool:
    """Return True if the image marks the occluded part of a silhouette (H, W) bool, if there is one.

    There the outline must be broken, without shading, and the image must name the occluder.
    """
    ink, shut = ink_of(DOUBTFUL if frame.doubt else TUMOUR_COLOUR), closed(frame)
    least, most = BROKEN_SHARES
    inked = inked_share(frame.shown, ink, mask, _above(frame) | ~shut)
    changed = changed_share(frame.picture.colour, frame.shown, mask & shut & (frame.taken == 0))
    return _said(frame, mask) and not (inked < least or inked > most or changed > CHANGED)  # NaN: none is there


def _said(frame: Frame, mask: np.ndarray) -> bool:
    seen = frame.picture.segmentation[mask & (frame.picture.segmentation != TOOL)]
    layers, counts = (each.tolist() for each in np.unique(seen, return_counts=True))
    share = float(np.isin(seen, OPENING.ids, invert=True).mean()) if len(seen) else 0.0
    if share < NOTICED + SLACK:
        return True
    words = OPENING.said(dict(zip(layers, counts, strict=True))).removeprefix("partly ")
    allowed = [words] * (share > WHOLE - SLACK) + [f"partly {words}"] * (share < WHOLE + SLACK)
    return any(all(stands(frame.shown, line, FINE) for line in ground_lines(said)) for said in allowed)


def printed(player: Player, frame: Frame) -> bool:
    """Return True if the image shows the frame number, the distance from tip to tumour, and the estimate."""
    if not stands(frame.shown, f"frame {frame.number}", FINE) or not _estimate_printed(player, frame):
        return False
    return frame.tip is None or _number(player, frame, frame.tip) is not None


def beside_tip(player: Player, frame: Frame) -> bool:
    """Return True if the distance is completely visible near the tip, or near the border if the tip is out of view."""
    if frame.tip is None:
        return True
    (tip,), _ = frame.camera.project(frame.tip[None])
    found = _number(player, frame, frame.tip)
    if found is None or not np.isfinite(tip).all():
        return found is not None
    height, width = frame.shown.shape[:2]
    tip = np.clip(tip, 0, (width - 1, height - 1))
    away = tip - np.clip(tip, found[:2], found[2:])
    return bool(np.linalg.norm(away) <= FAR * width)


def _number(player: Player, frame: Frame, tip: np.ndarray) -> tuple[int, int, int, int] | None:
    """Find the box of the distance text in an image; None if it is not found."""
    corners = _corners(player, frame)
    distance, inside = _distance(player, frame, corners, tip), encloses(corners, tip)
    error = None if frame.doubt else frame.tumour_error.bound
    for off in (0.0, 0.5e-4, 1e-4):  # samples are never nearer than the surface: by less than what is printed
        text = gauge_words(distance - off, error, inside)
        at = found_at(frame.shown, text, GAUGE)
        if at is not None:
            return at
    return None


def _estimate_printed(player: Player, frame: Frame) -> bool:
    """Return True if the image shows the estimated tumour motion and its error as computed here."""
    found = frame.estimate
    if found is None or found.location is None:
        return True
    anatomy, rest = player.site.anatomy, player.site.anatomy.mesh.nodes
    true, moved = middle_of(
        anatomy, np.stack([player.positions(frame.deformation) - rest, player.believed(frame) - rest])
    )
    off, length = float(np.linalg.norm(moved - true)), float(np.linalg.norm(moved))
    said = [
        line
        for text in (f"{ESTIMATED_LINES.motion} {millimetres(length, found.location.p95)}", frame.remark)
        for line in folded(text, NARROW * frame.shown.shape[1])
    ]
    return frame.remark.endswith(f"error {1e3 * off:.1f} mm") and all(stands(frame.shown, text, FINE) for text in said)


def _corners(player: Player, frame: Frame) -> np.ndarray:
    """Corners (S, 3, 3) [m] of the tumour's triangles as they are drawn."""
    return player.believed(frame)[player.stage.at(frame.loads).anatomy.tumour_surface]


def _distance(player: Player, frame: Frame, corners: np.ndarray, tip: np.ndarray) -> float:
    """Compute the distance from tip to tumour [m] by sampling the drawn surfaces, corrected by the model."""
    apart = float(np.linalg.norm(np.einsum("qc,scx->sqx", SAMPLES, corners) - tip, axis=2).min())
    model = answering(player.deformer, frame.deformation)
    if model is None:
        return apart
    return float(model.distance(frame.loads, frame.deformation, np.array([apart])).value[0])
