"""Hidden surface that shines through the ground, the dimmed ground round it, and lines over and under it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import warp as wp

from ..optics.camera import Camera
from ..rendering.layer import Layer, compute_vertex_normals
from ..rendering.lens_rasteriser import undistort_pixel
from ..rendering.parallel import forward_kernel, launch_in_bands, load_modules
from ..rendering.rasteriser import EMPTY_PIXEL, RasterisedSurface, unpack_depth, unpack_face
from ..rendering.renderer import Pictures
from ..rendering.triangle import compute_weights_from_corners

FADE_DEPTH = wp.constant(0.03)  # Depth under the surface over which light falls to 1 / e [m].
SOFT_EDGE_WIDTH = wp.constant(24)  # Width of the window's soft edge round the silhouette [pixel].
STRAIGHT_STEP = wp.constant(0.955)  # Length of a straight chamfer step, as in OpenCV [pixel].
DIAGONAL_STEP = wp.constant(1.3693)  # Length of a diagonal chamfer step, as in OpenCV [pixel].
CHAMFER_RADIUS = wp.constant(26)  # Search radius of the chamfer distance [pixel]: covers the soft edge.
HALF_LINE_WIDTH = wp.constant(1.7)  # Half the width of the outline [pixel].
HALF_BORDER_WIDTH = wp.constant(2.7)  # Half the width of the outline with its dark border [pixel].
MAX_EDGE_DISTANCE = wp.constant(
    5.0
)  # Distance from the silhouette's edge within which outline and border are drawn [pixel].
DEPTH_STEP = wp.constant(0.005)  # Width of a depth step of the style `depth` [m].
DEPTH_STEP_COUNT = wp.constant(6)  # Number of depth steps of the style `depth`.
MAX_TINT_OPACITY = wp.constant(0.85)  # Opacity of the tint at the surface.
MIN_TINT_OPACITY = wp.constant(0.1)  # Opacity of the tint at the last depth step.
# Roles of a layer: in front of the overlay; closed ground, through which nothing shines.
FRONT, CLOSED_GROUND = wp.constant(1), wp.constant(2)
# Shading of the ground inside the silhouette.
WINDOW_SHADING, TINT_SHADING, DEPTH_SHADING = wp.constant(1), wp.constant(2), wp.constant(3)
SHADES = {"window": WINDOW_SHADING, "fill": TINT_SHADING, "depth": DEPTH_SHADING}
"""Shading of the ground inside the silhouette by style; other styles have none."""
BORDER_COLOUR = (10.0, 12.0, 12.0)  # Colour of the dark border of lines (RGB).
BORDER_INK = wp.constant(wp.vec3f(*BORDER_COLOUR))  # Colour of the dark border for kernels.


@dataclass(frozen=True, eq=False)
class OverlayLines:
    """Lines of an overlay in a box of the image.

    Parameters
    ----------
    colour
        Colour (3,) in 0 .. 255 of the hidden surface's outline and tint.
    is_solid
        True if the outline is drawn as one solid line.
    canvas_below, canvas_above
        Further lines (h, w, 4) uint8, premultiplied colour and coverage, below and above the outline; None: no lines.
    """

    colour: tuple[float, float, float]
    is_solid: bool = True
    canvas_below: np.ndarray | None = None
    canvas_above: np.ndarray | None = None


def draw_overlay(
    images: Pictures, box: tuple[slice, slice], camera: Camera, layer: Layer, surface: RasterisedSurface,
    roles: LayerRoles, style: str, lines: OverlayLines,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Draw an overlay; return the image (H, W, 3) uint8, and the mask (h, w) uint8 of the lines in the box.

    Parameters
    ----------
    images
        Image to draw into, as a batch of one, on its device.
    box, camera
        Rows and columns of the image part to draw in, and the camera of that part.
    layer, surface
        Hidden surface, and its rasterised form for that camera, on the image's device.
    roles
        Roles of the layers: in front of the overlay, or closed ground.
    style
        "window": the surface shines through, and the ground round it is dimmed. "fill": the silhouette is tinted.
        "depth": it is tinted more where the surface is closer to the ground.
    """
    device = str(images.colour.device)
    load_modules(device, __name__)
    towards = compute_vertex_normals(layer.vertices, layer.triangles) @ camera.T_camera_world[2, :3]
    looks = np.column_stack([towards, 255.0 * np.asarray(layer.colour)])
    front = wp.empty((0, 0), dtype=wp.uint8, device=device)
    if roles.occluder_mask is not None:
        front = wp.array(roles.occluder_mask.view(np.uint8), dtype=wp.uint8, device=device)
    inputs = [
        box[0].start, box[1].start, camera.width, surface.z_buffer[0], surface.points, surface.triangles,
        surface.undistortion.pixels, compute_edge_distance(surface), wp.array(looks, dtype=wp.vec4f, device=device),
        images.depth[0], images.segmentation[0], get_role_table(roles.front_ids, roles.open_ids, device), front,
        int(SHADES.get(style, 0)), lines.is_solid, wp.vec3f(lines.colour),
        to_flat_canvas(lines.canvas_below, device), to_flat_canvas(lines.canvas_above, device),
    ]  # fmt: skip
    ground = wp.clone(images.colour[0])
    taken = wp.empty((camera.height, camera.width), dtype=wp.uint8, device=device)
    launch_in_bands(composite_pixels, inputs, [ground, taken], taken.size, device, per_core=2)
    return ground.numpy(), taken.numpy()


@dataclass(frozen=True, eq=False)
class LayerRoles:
    """Roles of an image's layers for an overlay.

    Parameters
    ----------
    front_ids
        Ids of layers in front of the overlay, which stay unchanged, such as tools.
    open_ids
        Ids of layers through which the surface may shine; None: all.
    occluder_mask
        Mask (H, W) bool of other parts that stay unchanged, such as a hand in a camera image; None: no such parts.
    """

    front_ids: tuple[int, ...] = ()
    open_ids: tuple[int, ...] | None = None
    occluder_mask: np.ndarray | None = None

    def read_roles(self, segmentation: np.ndarray, box: tuple[slice, slice] = np.s_[:, :]) -> np.ndarray:
        """Return the roles (h, w) uint8 (`FRONT`, `CLOSED_GROUND`, 0) in a box of a segmentation (H, W) uint8."""
        found = cv2.LUT(segmentation[box], build_role_table(self.front_ids, self.open_ids))
        if self.occluder_mask is not None:
            found[self.occluder_mask[box]] = FRONT
        return found


@lru_cache(maxsize=8)
def build_role_table(front_ids: tuple[int, ...], open_ids: tuple[int, ...] | None) -> np.ndarray:
    """Build the table (256,) uint8 from a layer's id to its role: `FRONT`, `CLOSED_GROUND` or 0."""
    ids = np.arange(256)
    shut = np.zeros(256, bool) if open_ids is None else ~np.isin(ids, open_ids)
    return np.where(np.isin(ids, front_ids), FRONT, np.where(shut, CLOSED_GROUND, 0)).astype(np.uint8)


@lru_cache(maxsize=8)
def get_role_table(front_ids: tuple[int, ...], open_ids: tuple[int, ...] | None, device: str) -> wp.array:
    """Return the table of `build_role_table` on a device; it is copied there once."""
    return wp.array(build_role_table(front_ids, open_ids), dtype=wp.uint8, device=device)


def to_flat_canvas(canvas: np.ndarray | None, device: str) -> wp.array:
    """Copy a canvas (h, w, 4) to a device as a flat array; None gives an empty array."""
    if canvas is None:
        return wp.empty(0, dtype=wp.vec4ub, device=device)
    return wp.array(canvas.reshape(-1, 4), dtype=wp.vec4ub, device=device, copy=False)


def compute_edge_distance(surface: RasterisedSurface) -> wp.array:
    """Compute the chamfer distance (h, w) [pixel] of each pixel from the silhouette's edge, up to `CHAMFER_RADIUS`.

    On the CPU it is computed by OpenCV; on a GPU, kernels give the same result.
    """
    device, shape = str(surface.z_buffer.device), surface.z_buffer.shape[1:]
    beside = wp.empty(shape, dtype=wp.uint8, device=device)
    launch_in_bands(mark_edges, [surface.z_buffer[0]], [beside], beside.size, device)
    if device != "cpu":
        return compute_chamfer_distance(beside, device)
    distance = cv2.distanceTransform(beside.numpy(), cv2.DIST_L2, cv2.DIST_MASK_3)
    return wp.array(distance, dtype=wp.float32, device=device, copy=False)


def compute_chamfer_distance(non_edge: wp.array, device: str) -> wp.array:
    """Compute the chamfer distance (h, w) [pixel] from the pixels where `non_edge` is 0, up to `CHAMFER_RADIUS`."""
    aside = wp.empty(non_edge.shape, dtype=wp.int32, device=device)
    distance = wp.empty(non_edge.shape, dtype=wp.float32, device=device)
    launch_in_bands(compute_row_distance, [non_edge], [aside], non_edge.size, device)
    launch_in_bands(compute_pixel_distance, [aside], [distance], non_edge.size, device)
    return distance


@forward_kernel
def mark_edges(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, z_buffer: wp.array2d(dtype=wp.uint64),
    # output
    non_edge: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Set each edge pixel to 0, others to 1: the surface is visible there, but not at one of its four neighbours."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        row = index / z_buffer.shape[1]
        column = index - row * z_buffer.shape[1]
        within = wp.uint8(1)
        if z_buffer[row, column] != EMPTY_PIXEL:
            up = z_buffer[wp.max(row - 1, 0), column] == EMPTY_PIXEL
            down = z_buffer[wp.min(row + 1, z_buffer.shape[0] - 1), column] == EMPTY_PIXEL
            left = z_buffer[row, wp.max(column - 1, 0)] == EMPTY_PIXEL
            right = z_buffer[row, wp.min(column + 1, z_buffer.shape[1] - 1)] == EMPTY_PIXEL
            if up or down or left or right:
                within = wp.uint8(0)
        non_edge[row, column] = within


@forward_kernel
def compute_row_distance(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, non_edge: wp.array2d(dtype=wp.uint8),
    # output
    row_distance: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Compute the distance of each pixel to the nearest edge pixel in its row [columns], at most `CHAMFER_RADIUS`."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        row = index / non_edge.shape[1]
        column = index - row * non_edge.shape[1]
        least = wp.int32(CHAMFER_RADIUS)
        for other in range(wp.max(column - CHAMFER_RADIUS, 0), wp.min(column + CHAMFER_RADIUS + 1, non_edge.shape[1])):
            if non_edge[row, other] == wp.uint8(0):
                least = wp.min(least, wp.abs(other - column))
        row_distance[row, column] = least


@forward_kernel
def compute_pixel_distance(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, row_distance: wp.array2d(dtype=wp.int32),
    # output
    distance: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Compute the chamfer distance: the shortest path of straight and diagonal steps to the nearest edge pixel."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        row = index / row_distance.shape[1]
        column = index - row * row_distance.shape[1]
        least = wp.float32(2 * CHAMFER_RADIUS)
        for other in range(wp.max(row - CHAMFER_RADIUS, 0), wp.min(row + CHAMFER_RADIUS + 1, row_distance.shape[0])):
            away = wp.abs(other - row)
            slanted = wp.min(away, row_distance[other, column])
            straight = wp.max(away, row_distance[other, column]) - slanted
            least = wp.min(least, STRAIGHT_STEP * wp.float32(straight) + DIAGONAL_STEP * wp.float32(slanted))
        distance[row, column] = least


@wp.func
def smooth_distance(
    row: wp.int32, column: wp.int32, distance: wp.array2d(dtype=wp.float32), z_buffer: wp.array2d(dtype=wp.uint64)
) -> wp.float32:
    """Compute a pixel's signed distance from the silhouette, < 0 inside, as mean of nine pixels to hide steps."""
    total = wp.float32(0.0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            y = wp.clamp(row + i, 0, distance.shape[0] - 1)
            x = wp.clamp(column + j, 0, distance.shape[1] - 1)
            total += wp.where(z_buffer[y, x] == EMPTY_PIXEL, distance[y, x], -distance[y, x])
    return total / 9.0


@wp.func
def blend_over(line: wp.vec4ub, background: wp.vec3f) -> wp.vec3f:
    """Blend a line (premultiplied colour, coverage) over a background colour."""
    left = 1.0 - wp.float32(line[3]) / 255.0
    return left * background + wp.vec3f(wp.float32(line[0]), wp.float32(line[1]), wp.float32(line[2]))


@wp.func
def shade_through_ground(
    p: wp.vec3d, key: wp.uint64, q: wp.array2d(dtype=wp.vec3d), triangles: wp.array(dtype=wp.vec3i),
    appearance: wp.array(dtype=wp.vec4f), ground_depth: wp.float32,
) -> wp.vec3f:  # fmt: skip
    """Compute the light of a hidden surface at a pixel p = (u, v, 1), seen through ground at `ground_depth` [m].

    The depth below the ground counts as 0 if `ground_depth` is 0.
    """
    t = triangles[unpack_face(key)]
    w = compute_weights_from_corners(p, q[0, t[0]], q[0, t[1]], q[0, t[2]])
    look = w[0] * appearance[t[0]] + w[1] * appearance[t[1]] + w[2] * appearance[t[2]]
    under = wp.float32(0.0)
    if ground_depth > 0.0:
        under = wp.max(unpack_depth(key) - ground_depth, 0.0)
    return 1.1 * (0.25 + 0.75 * wp.abs(look[0])) * wp.exp(-under / FADE_DEPTH) * wp.vec3f(look[1], look[2], look[3])


@wp.func
def compute_tint_opacity(depth: wp.float32) -> wp.float32:
    """Compute the opacity of the depth style's tint for a depth [m] below the ground."""
    share = wp.clamp(wp.floor(depth / DEPTH_STEP) / wp.float32(DEPTH_STEP_COUNT - 1), 0.0, 1.0)
    return MAX_TINT_OPACITY - (MAX_TINT_OPACITY - MIN_TINT_OPACITY) * share


@forward_kernel
def composite_pixels(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, top: wp.int32, left: wp.int32, width: wp.int32,
    z_buffer: wp.array2d(dtype=wp.uint64), q: wp.array2d(dtype=wp.vec3d), triangles: wp.array(dtype=wp.vec3i),
    pixels: wp.array3d(dtype=wp.vec2d), edge_distance: wp.array2d(dtype=wp.float32),
    appearance: wp.array(dtype=wp.vec4f), depth: wp.array2d(dtype=wp.float32),
    segmentation: wp.array2d(dtype=wp.uint8), roles: wp.array(dtype=wp.uint8), front: wp.array2d(dtype=wp.uint8),
    style: wp.int32, has_outline: wp.bool, colour: wp.vec3f, lines_below: wp.array(dtype=wp.vec4ub),
    lines_above: wp.array(dtype=wp.vec4ub),
    # outputs
    image: wp.array2d(dtype=wp.vec3ub), occupied: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Composite pixels begin .. end - 1 of the box; `edge_distance` is that of each pixel from the silhouette's edge.

    `appearance` has, per vertex of the hidden surface, its normal's cosine to the optical axis and colour in 0 .. 255.
    """
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        row = index / width
        column = index - row * width
        y = top + row
        x = left + column
        role = wp.int32(roles[wp.int32(segmentation[y, x])])
        free = role != FRONT
        if front.shape[0] > 0 and front[y, x] != wp.uint8(0):
            free = False
        through = role != CLOSED_GROUND
        key = z_buffer[row, column]
        inside = through and key != EMPTY_PIXEL
        window = wp.float32(0.0)
        if style == WINDOW_SHADING and through:
            window = wp.where(
                inside, 1.0, wp.clamp(1.25 - 1.25 * edge_distance[row, column] / wp.float32(SOFT_EDGE_WIDTH), 0.0, 1.0)
            )
        # Coverage by the outline's dark rim, and by its ink.
        rim = wp.float32(0.0)
        line = wp.float32(0.0)
        if has_outline and through and edge_distance[row, column] < MAX_EDGE_DISTANCE:
            far = wp.abs(smooth_distance(row, column, edge_distance, z_buffer))
            rim = wp.clamp(HALF_BORDER_WIDTH + 0.5 - far, 0.0, 1.0)
            line = wp.clamp(HALF_LINE_WIDTH + 0.5 - far, 0.0, 1.0)
        low = wp.vec4ub(wp.uint8(0))
        high = wp.vec4ub(wp.uint8(0))
        if lines_below.shape[0] > 0:
            low = lines_below[index]
        if lines_above.shape[0] > 0:
            high = lines_above[index]
        lined = rim > 0.0 or low[3] > wp.uint8(0) or high[3] > wp.uint8(0)
        occupied[row, column] = wp.uint8(wp.where(lined and free, 1, 0))
        if free and (lined or window > 0.0 or (style > WINDOW_SHADING and inside)):
            was = image[y, x]
            light = wp.vec3f(wp.float32(was[0]), wp.float32(was[1]), wp.float32(was[2]))
            if style == WINDOW_SHADING:
                light *= 1.0 - 0.62 * window * window * (3.0 - 2.0 * window)
                if inside:
                    p = undistort_pixel(0, column, row, pixels)
                    light += shade_through_ground(p, key, q, triangles, appearance, depth[y, x])
            light = wp.min(light, wp.vec3f(255.0))
            if inside and style == TINT_SHADING:
                light = 0.55 * light + 0.45 * colour
            if inside and style == DEPTH_SHADING:
                light += compute_tint_opacity(unpack_depth(key) - depth[y, x]) * (colour - light)
            light = blend_over(low, light)
            light = (1.0 - rim) * light + rim * BORDER_INK
            light = (1.0 - line) * light + line * colour
            light = blend_over(high, light)
            image[y, x] = wp.vec3ub(wp.uint8(light[0]), wp.uint8(light[1]), wp.uint8(light[2]))
