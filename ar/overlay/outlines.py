"""Outlines of surfaces: projection into the image, drawing, and detection in an image for tests."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering.rasteriser import rasterise_surface
from .hud import FONT, WHITE
from .window import BORDER_COLOUR, MAX_EDGE_DISTANCE, SOFT_EDGE_WIDTH

OPAQUE = 255  # Value of a canvas's fourth channel for complete coverage.
COARSE_SPACING = 16  # Grid spacing of the coarse search under lens distortion [pixel].


def average_colour(colour: np.ndarray | tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the mean of sRGB colours (3,) or (V, 3) in [0, 1] as a line colour: integers in 0 .. 255."""
    red, green, blue = np.rint(255.0 * np.asarray(colour, np.float64).reshape(-1, 3).mean(axis=0)).tolist()
    return red, green, blue


def allocate_canvas(camera: Camera) -> np.ndarray:
    """Allocate a canvas (h, w, 4) uint8 for lines: premultiplied colour, and coverage."""
    return np.zeros((camera.height, camera.width, 4), np.uint8)


def join_boxes(a: tuple[slice, slice] | None, b: tuple[slice, slice] | None) -> tuple[slice, slice] | None:
    """Return the smallest box, as rows and columns, that contains two boxes; None counts as empty."""
    if a is None or b is None:
        return a or b
    rows, columns = (slice(min(i.start, j.start), max(i.stop, j.stop)) for i, j in zip(a, b, strict=True))
    return rows, columns


def find_pixel_box(camera: Camera, points: np.ndarray) -> tuple[slice, slice] | None:
    """Return the box (rows, columns) of the pixels of points (V, 3) [m], widened by `SOFT_EDGE_WIDTH`.

    None if the box is outside the image.
    """
    pixels, depth = camera.project(points)
    if not (depth > 0.0).all():
        return slice(0, camera.height), slice(0, camera.width)
    if camera.lens is not None:
        pixels = find_pixel_corners(camera, points)
        if not len(pixels):
            return None
    low = np.maximum(np.floor(pixels.min(axis=0)) - SOFT_EDGE_WIDTH, 0.0).astype(int).tolist()
    high = (
        np.minimum(np.ceil(pixels.max(axis=0)) + SOFT_EDGE_WIDTH + 1.0, (camera.width, camera.height))
        .astype(int)
        .tolist()
    )
    box = slice(low[1], high[1]), slice(low[0], high[0])
    return box if all(side.start < side.stop for side in box) else None


def find_pixel_corners(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Find pixels (n, 2) whose box contains the image of a surface with points (V, 3) before a camera with a lens.

    A lens bends the lines between points, but in the undistorted image they remain inside the points' box.
    """
    ends, _ = replace(camera, lens=None).project(points)
    # Coarse grid first, with a margin of the largest step of the undistorted coordinates.
    step = COARSE_SPACING if min(camera.width, camera.height) > 2 * COARSE_SPACING else 1
    few = camera.straight[::step, ::step]
    steps = [np.abs(np.diff(few, axis=axis)).reshape(-1, 2) for axis in (0, 1)]
    room = 1.0 + np.nan_to_num(np.concatenate(steps)).max(axis=0, initial=0.0)
    rows, columns = (step * where for where in _find_box_pixels(few, ends.min(axis=0) - room, ends.max(axis=0) + room))
    corners = np.zeros((0, 2))
    if len(rows):
        top, left = max(rows[0] - step, 0), max(columns[0] - step, 0)
        part = camera.straight[top : rows[-1] + step + 1, left : columns[-1] + step + 1]
        rows, columns = _find_box_pixels(part, ends.min(axis=0), ends.max(axis=0))
        corners = np.array([(left + columns[end], top + rows[end]) for end in (0, -1) if len(rows)]).reshape(-1, 2)
    near, _ = camera.project(points)
    return np.concatenate([corners, near[np.isfinite(near).all(axis=1)]])


def _find_box_pixels(undistorted: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns with undistorted positions (h, w, 2) between two corners (2,)."""
    inside = np.all((undistorted >= low) & (undistorted <= high), axis=2)
    return np.flatnonzero(np.any(inside, axis=1)), np.flatnonzero(np.any(inside, axis=0))


def compute_silhouette(camera: Camera, vertices: np.ndarray, triangles: np.ndarray, device: str = "cpu") -> np.ndarray:
    """Compute the mask (H, W) bool of the pixels whose centres a surface covers: vertices (V, 3) [m], triangles (F, 3).

    `device` is the Warp device that rasterises the surface.
    """
    return rasterise_surface(camera, vertices, triangles, device=device).mask


def compute_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Compute the intersection over union of two masks (H, W); 0 if both are empty."""
    union = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / union) if union else 0.0


def find_outlines(mask: np.ndarray) -> list[np.ndarray]:
    """Return the closed outer outlines of a mask (H, W), each as pixels (n, 1, 2) int32."""
    return list(cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])


def draw_dashes(
    canvas: np.ndarray, lines: Sequence[np.ndarray], colour: Sequence[float], pattern: tuple[int, int], width: int = 2
) -> None:
    """Draw outlines (n, 1, 2) as dashes, in place; `pattern` gives the lengths of stroke and gap [pixel].

    Lines wider than one pixel have a dark border. Nothing is drawn along the canvas's edge, where outlines are cut.
    """
    stroke, gap = pattern
    lines = [piece for line in lines for piece in clip_to_canvas(line, canvas.shape[1], canvas.shape[0])]
    strokes = [line[start : start + stroke] for line in lines for start in range(0, len(line), stroke + gap)]
    if width > 1:
        cv2.polylines(canvas, strokes, False, (*BORDER_COLOUR, OPAQUE), width + 2, cv2.LINE_AA)
    cv2.polylines(canvas, strokes, False, (*colour, OPAQUE), width, cv2.LINE_AA)


def blend_canvas(image: np.ndarray, canvas: np.ndarray, mask: np.ndarray) -> None:
    """Draw a canvas (h, w, 4) of lines on an image (h, w, 3) uint8 where `mask` (h, w) is True, in place."""
    drawn = mask & (canvas[..., 3] > 0)
    line, left = canvas[drawn, :3], 255 - canvas[drawn, 3:].astype(int)
    image[drawn] = (image[drawn] * left // 255 + line).astype(np.uint8)


def clip_to_canvas(outline: np.ndarray, width: int, height: int) -> list[np.ndarray]:
    """Return the pieces of an outline (n, 1, 2) inside a canvas, away from the canvas's edge."""
    inside = (outline >= MAX_EDGE_DISTANCE) & (outline < (width - MAX_EDGE_DISTANCE, height - MAX_EDGE_DISTANCE))
    return split_by_mask(outline, inside.all(axis=(1, 2)))


def clip_to_mask(outlines: Sequence[np.ndarray], mask: np.ndarray) -> list[np.ndarray]:
    """Return the pieces of outlines (n, 1, 2) whose pixels are in a mask (H, W) bool."""
    return [piece for line in outlines for piece in split_by_mask(line, mask[line[:, 0, 1], line[:, 0, 0]])]


def split_by_mask(line: np.ndarray, mask: np.ndarray) -> list[np.ndarray]:
    """Return the pieces of a line (n, 1, 2) for which `mask` (n,) is True; [] for an empty line."""
    if not len(line):
        return []
    cuts = np.flatnonzero(np.diff(mask)) + 1
    return [piece for piece, wanted in zip(np.split(line, cuts), np.split(mask, cuts), strict=True) if wanted[0]]


def shift_shade(colour: Sequence[float]) -> tuple[float, ...]:
    """Return a colour (3,) in 0 .. 255 slightly changed, so that only the outline has the original colour."""
    return tuple(share + 8.0 if share < 128.0 else share - 8.0 for share in colour)


COLOUR_TOLERANCE = 2  # Colour tolerance in each channel; line centres have the exact colour within rounding.
# Reported percentile of the outline pixels' distances [%], to exclude corners and crossings of lines.
DISTANCE_PERCENTILE = 95.0
CUT_DISTANCE = 5  # Distance from occluders or the image border within which an outline may be cut [pixel].
LINE_DISTANCE = 6  # Distance from a mask's edge within which lines may be drawn [pixel].
MIN_PIXELS = 60  # Minimum number of pixels for a share.
TEXT_MARGIN = 8  # Margin round a text that must not have its colour, so that "1.5" is not found in "11.5" [pixel].


def measure_outline_distance(
    image: np.ndarray, colour: Sequence[float], silhouette: np.ndarray, occluders: np.ndarray, min_pixels: int = 1,
    gap_length: float = 0.0,
) -> float:  # fmt: skip
    """Compute the distance [pixel] between the outline drawn in an image and the expected outline.

    It is the larger of two 95th percentiles: from drawn pixels to the expected outline, and from the expected outline
    to drawn pixels. 0 if neither is visible, infinite if only one is visible.

    Parameters
    ----------
    image, colour
        Image (H, W, 3) uint8, and the outline's colour (3,) in 0 .. 255.
    silhouette
        Mask (H, W) bool of the expected silhouette.
    occluders
        Mask (H, W) bool of objects in front of the overlay.
    min_pixels
        Smallest number of pixels that counts. Above 1, each outline is compared with the whole other outline, also
        where that is covered, as the visible part of a broken line may be a gap.
    gap_length
        Length of the gaps of a broken line [pixel]; half of it is subtracted from distances to drawn pixels.
    """
    found = find_colour(image, colour)
    true = np.zeros(silhouette.shape, np.uint8)
    for outline in find_outlines(silhouette):
        cv2.polylines(true, [outline], True, (1,))
    shut = cv2.dilate(
        np.pad(occluders, 1, constant_values=True).astype(np.uint8), np.ones((2 * CUT_DISTANCE + 1,) * 2, np.uint8)
    )
    seen = shut[1:-1, 1:-1] == 0
    wanted = (true > 0) & seen
    if max(np.count_nonzero(wanted), np.count_nonzero(found & seen)) < min_pixels:
        return 0.0
    there = (true > 0, found) if min_pixels > 1 else (wanted, found & seen)
    if not all(each.any() for each in there):
        return np.inf
    apart = (
        _compute_distance(true > 0)[found & seen],
        np.maximum(_compute_distance(found)[wanted] - 0.5 * gap_length, 0.0),
    )
    return float(max(np.percentile(each, DISTANCE_PERCENTILE) for each in apart if len(each)))


def find_colour(image: np.ndarray, colour: Sequence[float], tolerance: int = COLOUR_TOLERANCE) -> np.ndarray:
    """Return the mask (H, W) bool of pixels of an image (H, W, 3) uint8 within `tolerance` of a colour (3,)."""
    low, high = (tuple(np.clip(np.rint(colour) + by, 0, 255).tolist()) for by in (-tolerance, tolerance))
    return cv2.inRange(np.ascontiguousarray(image), low, high) > 0


def _compute_distance(mask: np.ndarray) -> np.ndarray:
    """Compute the distance (H, W) [pixel] of each pixel from the nearest pixel in a mask (H, W)."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def has_text(image: np.ndarray, text: str, scale: float, colour: Sequence[float] = WHITE) -> bool:
    """Return True if an image (H, W, 3) uint8 has exactly this text at this scale, as drawn by `hud.write_text`."""
    return find_text(image, text, scale, colour) is not None


def find_text(
    image: np.ndarray, text: str, scale: float, colour: Sequence[float] = WHITE
) -> tuple[int, int, int, int] | None:
    """Find text drawn by `hud.write_text`; return left, top, right and bottom [pixel], or None if not found."""
    (width, above), below = cv2.getTextSize(text, FONT, scale, 1)
    blank = np.zeros((above + below + 2, width + 2 * TEXT_MARGIN, 3), np.uint8)
    cv2.putText(blank, text, (TEXT_MARGIN, above + 1), FONT, scale, tuple(colour), 1, cv2.LINE_AA)
    shape = (blank == colour).all(axis=2).astype(np.float32)
    here = np.pad(find_colour(image, colour, 0), TEXT_MARGIN).astype(np.float32)
    if shape.shape[0] > here.shape[0] or shape.shape[1] > here.shape[1]:
        return None
    right = cv2.matchTemplate(here, shape, cv2.TM_CCORR)
    every = cv2.matchTemplate(here, np.ones_like(shape), cv2.TM_CCORR)
    count = shape.sum()
    # All of the text's pixels, and no other pixel of its colour between them.
    places = np.argwhere((right > count - 0.5) & (every < count + 0.5))
    if not len(places):
        return None
    left, foot = int(places[0, 1]), int(places[0, 0]) + above + 1 - TEXT_MARGIN + below
    return left, foot - below - above, left + width, foot


def compute_drawn_share(
    image: np.ndarray, colour: Sequence[float], silhouette: np.ndarray, occluders: np.ndarray
) -> float:
    """Compute the share of a silhouette's outline that has a given colour in an image.

    NaN for an outline of fewer than `MIN_PIXELS` pixels.

    The parameters are as in `measure_outline_distance`; pixels near occluders and the image border are left out.
    """
    outline = np.zeros(silhouette.shape, np.uint8)
    cv2.drawContours(outline, find_outlines(silhouette), -1, (1,))
    shut = cv2.dilate(
        np.pad(occluders, 1, constant_values=True).astype(np.uint8), np.ones((2 * CUT_DISTANCE + 1,) * 2, np.uint8)
    )
    return _compute_share(find_colour(image, colour), (outline > 0) & (shut[1:-1, 1:-1] == 0))


def compute_changed_share(first_image: np.ndarray, second_image: np.ndarray, mask: np.ndarray) -> float:
    """Compute the share of pixels in a mask (H, W) bool, without its edge, that differ between images (H, W, 3) uint8.

    NaN for fewer than `MIN_PIXELS` pixels.
    """
    inner = cv2.erode(mask.astype(np.uint8), np.ones((2 * LINE_DISTANCE + 1,) * 2, np.uint8), borderValue=0) > 0
    return _compute_share(~find_colour(cv2.absdiff(first_image, second_image), (0, 0, 0)), inner)


def _compute_share(values: np.ndarray, mask: np.ndarray) -> float:
    return float(values[mask].mean()) if np.count_nonzero(mask) >= MIN_PIXELS else np.nan
