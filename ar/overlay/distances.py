"""Distances of points and pixels from a closed surface, computed with a BVH, and lines of equal distance."""

from collections.abc import Sequence

import cv2
import numpy as np
import warp as wp

from ..optics.camera import Camera
from ..rendering.parallel import forward_kernel, launch_in_bands, load_modules
from .hud import FONT, TEXT_SCALE
from .outlines import OPAQUE, clip_to_canvas, clip_to_mask, find_outlines
from .window import BORDER_COLOUR

RAY_COUNT = wp.constant(3)  # Number of rays of the inside test; it is odd, so that there is always a majority.


def build_bvh(vertices: np.ndarray, triangles: np.ndarray, device: str = "cpu") -> wp.Mesh:
    """Build a bounding volume hierarchy of triangles (F, 3) with vertices (V, 3) [m], on a device."""
    points = wp.array(vertices, dtype=wp.vec3f, device=device)
    return wp.Mesh(points, wp.array(np.asarray(triangles, np.int32).ravel(), dtype=wp.int32, device=device))


def compute_signed_distance(bvh: wp.Mesh, points: np.ndarray, max_distance: float) -> np.ndarray:
    """Compute signed distances (n,) float32 [m] of points (n, 3) [m], < 0 inside; NaN beyond `max_distance` [m]."""
    device = str(bvh.device)
    load_modules(device, __name__)
    at = wp.array(points, dtype=wp.vec3f, device=device)
    found = wp.empty(len(points), dtype=wp.float32, device=device)
    launch_in_bands(measure_point_distances, [bvh.id, at, float(max_distance)], [found], len(points), device)
    return found.numpy()


def compute_visible_distance(
    bvh: wp.Mesh, camera: Camera, box: tuple[slice, slice], depth: wp.array, mask: np.ndarray, max_distance: float
) -> np.ndarray:
    """Compute the distance (h, w) float32 [m] between a surface and the visible point at each pixel of a box.

    NaN beyond `max_distance` [m], and where `mask` (h, w) bool is False.

    Parameters
    ----------
    camera, depth
        Camera of the whole image, and its depth (H, W) float32 [m] (z in the camera frame), on the BVH's device.
    box
        Rows and columns of the box in the image.
    """
    device = str(bvh.device)
    load_modules(device, __name__)
    rows, columns = box
    rays = np.concatenate([camera.straight[rows, columns], np.ones((*mask.shape, 1))], axis=2)
    turn = camera.T_camera_world[:3, :3].T @ np.linalg.inv(camera.K)
    found = wp.empty(mask.shape, dtype=wp.float32, device=device)
    inputs = [
        bvh.id, rows.start, columns.start, wp.array(rays @ turn.T, dtype=wp.vec3f, device=device),
        wp.vec3f(camera.centre), depth, wp.array(np.ascontiguousarray(mask).view(np.uint8), device=device),
        float(max_distance),
    ]  # fmt: skip
    launch_in_bands(measure_visible_distances, inputs, [found], found.size, device, per_core=4)
    return found.numpy()


@forward_kernel
def measure_point_distances(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, bvh: wp.uint64, points: wp.array(dtype=wp.vec3f),
    max_distance: wp.float32,
    # output
    distance: wp.array(dtype=wp.float32),
):  # fmt: skip
    """Compute the signed distances of a chunk of points."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        found = wp.mesh_query_point_sign_parity(bvh, points[index], max_distance, RAY_COUNT)
        distance[index] = wp.nan
        if found.result:
            nearest = wp.mesh_eval_position(bvh, found.face, found.u, found.v)
            distance[index] = found.sign * wp.length(points[index] - nearest)


@forward_kernel
def measure_visible_distances(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, bvh: wp.uint64, top: wp.int32, left: wp.int32,
    rays: wp.array2d(dtype=wp.vec3f), centre: wp.vec3f, depth: wp.array2d(dtype=wp.float32),
    mask: wp.array2d(dtype=wp.uint8), max_distance: wp.float32,
    # output
    distance: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Compute the distances of the visible points for a chunk of the box's pixels; `rays` have z = 1."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        row = index / distance.shape[1]
        column = index - row * distance.shape[1]
        distance[row, column] = wp.nan
        far = depth[top + row, left + column]
        if mask[row, column] != wp.uint8(0) and far > 0.0:
            point = centre + far * rays[row, column]
            found = wp.mesh_query_point_no_sign(bvh, point, max_distance)
            if found.result:
                nearest = wp.mesh_eval_position(bvh, found.face, found.u, found.v)
                distance[row, column] = wp.length(point - nearest)


RING_DISTANCES = (1e-3, 5e-3, 10e-3, 15e-3)  # Distances of the rings from the surface [m]; the first indicates contact.
RING_COLOUR = (232.0, 228.0, 204.0)
"""Colour of rings and of their numbers (RGB)."""
MIN_RING_LENGTH = 24  # Smallest length of a drawn ring [pixel].
EDGE_DISTANCE = 3  # Distance of rings from the edge of the ground [pixel].
NUMBER_GAP = 3  # Gap on all sides of a ring's number [pixel].
# Side of the morphological opening that separates numbers from lines [pixel]: between their thicknesses.
OPENING_SIDE = 9
MIN_NUMBERED_LENGTH = 80  # Smallest length of a piece of a ring with a number of its own [pixel].


def draw_rings(
    canvas: np.ndarray, distance: np.ndarray, free_mask: np.ndarray, levels: Sequence[float] = RING_DISTANCES
) -> list[str]:
    """Draw rings of equal distance with their numbers in millimetres, in place; return the drawn numbers.

    Each long piece of a ring has a number, and each ring has at least one number, which may cover other lines.

    Parameters
    ----------
    canvas
        Canvas (h, w, 4) uint8: premultiplied colour, and coverage.
    distance
        Distance (h, w) float32 [m] of the visible point at each pixel from the hidden surface; NaN excludes a pixel.
    free_mask
        Mask (h, w) bool of pixels that numbers may cover; False at other lines.
    """
    ground = np.isfinite(distance).astype(np.uint8)
    within = cv2.erode(ground, np.ones((2 * EDGE_DISTANCE + 1,) * 2, np.uint8), borderValue=0) > 0
    rings: dict[str, list[np.ndarray]] = {}
    for level in levels:
        near = np.nan_to_num(distance, nan=np.inf) < level
        lines = [line for line in clip_to_mask(find_outlines(near), within) if len(line) >= MIN_RING_LENGTH]
        lines = [line for piece in lines for line in clip_to_canvas(piece, canvas.shape[1], canvas.shape[0])]
        if lines:
            rings[f"{1e3 * level:.0f}"] = sorted(lines, key=len, reverse=True)
    for lines in rings.values():
        for ink, width in ((BORDER_COLOUR, 3), (RING_COLOUR, 1)):
            cv2.polylines(canvas, lines, False, (*ink, OPAQUE), width, cv2.LINE_AA)
    taken, written = ~free_mask, np.zeros(free_mask.shape, bool)
    for number, lines in rings.items():
        found = [_label(canvas, line, number, taken, written) for line in lines if len(line) >= MIN_NUMBERED_LENGTH]
        if not any(found):
            # Without free space, the number covers lines, or else another number.
            any(
                _label(canvas, line, number, shut, written)
                for shut in (written, np.zeros_like(written))
                for line in lines
            )
    return list(rings)


def remove_labels(mask: np.ndarray) -> np.ndarray:
    """Return the mask (h, w) bool of the distance contours without their labels, from a mask of both."""
    numbers = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((OPENING_SIDE,) * 2, np.uint8))
    return mask & (numbers == 0)


def _label(canvas: np.ndarray, line: np.ndarray, text: str, occupied: np.ndarray, text_mask: np.ndarray) -> bool:
    """Write a number on a line (n, 1, 2), as near its centre as `occupied` allows; return False without space."""
    (width, height), _ = cv2.getTextSize(text, FONT, TEXT_SCALE, 1)
    middle = len(line) // 2
    for at in sorted(range(0, len(line), 4), key=lambda at: abs(at - middle)):
        column, row = line[at, 0].tolist()
        left, top = column - width // 2, row - height // 2
        box = (
            slice(max(top - NUMBER_GAP, 0), top + height + NUMBER_GAP),
            slice(max(left - NUMBER_GAP, 0), left + width + NUMBER_GAP),
        )
        if left >= NUMBER_GAP and top >= NUMBER_GAP and not occupied[box].any() and _is_within(canvas, box):
            cv2.rectangle(
                canvas, (left - 2, top - 2), (left + width + 1, top + height + 1), (*BORDER_COLOUR, OPAQUE), -1
            )
            cv2.putText(canvas, text, (left, top + height), FONT, TEXT_SCALE, (*RING_COLOUR, OPAQUE), 1, cv2.LINE_AA)
            occupied[box] = text_mask[box] = True
            return True
    return False


def _is_within(canvas: np.ndarray, box: tuple[slice, slice]) -> bool:
    return box[0].stop <= canvas.shape[0] and box[1].stop <= canvas.shape[1]
