"""Hidden surface that shines through the ground, which is dimmed round it, and the lines over and under it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import warp as wp

from ..optics.camera import Camera
from ..rendering.layer import Layer, compute_vertex_normals
from ..rendering.lens_rasteriser import pixel_at
from ..rendering.parallel import forward_kernel, launch_in_bands, load
from ..rendering.rasteriser import EMPTY_PIXEL, RasterisedSurface, depth_of, face_of
from ..rendering.renderer import Pictures
from ..rendering.triangle import weights_of

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
# Roles of a layer: in front of the overlay; ground that nothing shines through.
FRONT, CLOSED_GROUND = wp.constant(1), wp.constant(2)
# Shading of the ground inside the silhouette.
WINDOW_SHADING, TINT_SHADING, DEPTH_SHADING = wp.constant(1), wp.constant(2), wp.constant(3)
SHADES = {"window": WINDOW_SHADING, "fill": TINT_SHADING, "depth": DEPTH_SHADING}
"""Shading by style; none in other styles."""
BORDER_COLOUR = (10.0, 12.0, 12.0)  # Colour of the dark border of lines (RGB).
BORDER_INK = wp.constant(wp.vec3f(*BORDER_COLOUR))  # Colour of the dark border for kernels.


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of an overlay in a box of the image.

    Parameters
    ----------
    ink
        Colour (3,) in 0 .. 255 of the hidden surface's outline, and of its tint.
    solid
        True if the outline is drawn as one solid line.
    under, above
        (h, w, 4) uint8: colour times coverage, and coverage, of further lines, under the outline and above it; or None.
    """

    ink: tuple[float, float, float]
    solid: bool = True
    under: np.ndarray | None = None
    above: np.ndarray | None = None


def draw_overlay(
    drawn: Pictures,
    box: tuple[slice, slice],
    camera: Camera,
    hidden: Layer,
    seen: RasterisedSurface,
    roles: Roles,
    style: str,
    lines: Lines,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw an overlay; return the image (H, W, 3) uint8, and the mask of its lines, (h, w) uint8 of the box.

    Parameters
    ----------
    drawn
        Image to draw into, a batch of one, on its device.
    box, camera
        Rows and columns of the image in which to draw, and the camera of that part.
    hidden, seen
        The surface, and its rendering by that camera, on the same device.
    roles
        Parts that stay unchanged, and parts that nothing shines through.
    style
        "window" dims the ground round the silhouette, where the surface shines through; "fill" tints it; "depth" the
        more the closer the surface is to the ground.
    """
    device = str(drawn.colour.device)
    load(device, __name__)
    towards = compute_vertex_normals(hidden.vertices, hidden.triangles) @ camera.T_camera_world[2, :3]
    looks = np.column_stack([towards, 255.0 * np.asarray(hidden.colour)])
    front = wp.empty((0, 0), dtype=wp.uint8, device=device)
    if roles.covered is not None:
        front = wp.array(roles.covered.view(np.uint8), dtype=wp.uint8, device=device)
    inputs = [
        box[0].start, box[1].start, camera.width, seen.nearest[0], seen.points, seen.triangles, seen.unbent.pixels,
        from_edge(seen), wp.array(looks, dtype=wp.vec4f, device=device), drawn.depth[0], drawn.segmentation[0],
        get_on_device(roles.front, roles.open, device), front, int(SHADES.get(style, 0)), lines.solid,
            wp.vec3f(lines.ink),
        to_flat_sheet(lines.under, device), to_flat_sheet(lines.above, device),
    ]  # fmt: skip
    ground = wp.clone(drawn.colour[0])
    taken = wp.empty((camera.height, camera.width), dtype=wp.uint8, device=device)
    launch_in_bands(lay_over, inputs, [ground, taken], taken.size, device, bands=2)
    return ground.numpy(), taken.numpy()


@dataclass(frozen=True, eq=False)
class Roles:
    """Roles of an image's parts for an overlay.

    Parameters
    ----------
    front
        Ids of the layers that stay unchanged: tools.
    open
        Ids of those that the surface may shine through; None: all.
    covered
        (H, W) bool: further parts that stay unchanged, as a hand in a real image; or None.
    """

    front: tuple[int, ...] = ()
    open: tuple[int, ...] | None = None
    covered: np.ndarray | None = None

    def read_roles(self, segmentation: np.ndarray, box: tuple[slice, slice] = np.s_[:, :]) -> np.ndarray:
        """Return the roles (h, w) uint8, `FRONT`, `CLOSED_GROUND` or 0, in a box of a segmentation (H, W) uint8."""
        found = cv2.LUT(segmentation[box], build_role_table(self.front, self.open))
        if self.covered is not None:
            found[self.covered[box]] = FRONT
        return found


@lru_cache(maxsize=8)
def build_role_table(front: tuple[int, ...], open_to: tuple[int, ...] | None) -> np.ndarray:
    """Return the table (256,) uint8 of roles by the id of a layer: `FRONT`, `CLOSED_GROUND` or 0."""
    ids = np.arange(256)
    shut = np.zeros(256, bool) if open_to is None else ~np.isin(ids, open_to)
    return np.where(np.isin(ids, front), FRONT, np.where(shut, CLOSED_GROUND, 0)).astype(np.uint8)


@lru_cache(maxsize=8)
def get_on_device(front: tuple[int, ...], open_to: tuple[int, ...] | None, device: str) -> wp.array:
    """Return `build_role_table` on a device, copied there once."""
    return wp.array(build_role_table(front, open_to), dtype=wp.uint8, device=device)


def to_flat_sheet(lines: np.ndarray | None, device: str) -> wp.array:
    """Copy a sheet (h, w, 4) of lines to a device, flattened; empty if there is none."""
    if lines is None:
        return wp.empty(0, dtype=wp.vec4ub, device=device)
    return wp.array(lines.reshape(-1, 4), dtype=wp.vec4ub, device=device, copy=False)


def from_edge(seen: RasterisedSurface) -> wp.array:
    """Compute the chamfer distance (h, w) of each pixel from a silhouette's edge [pixel], up to the soft edge's width.

    OpenCV computes it on the CPU, kernels with the same result on a GPU.
    """
    device, shape = str(seen.nearest.device), seen.nearest.shape[1:]
    beside = wp.empty(shape, dtype=wp.uint8, device=device)
    launch_in_bands(find_edge, [seen.nearest[0]], [beside], beside.size, device)
    if device != "cpu":
        return compute_chamfer_distance(beside, device)
    distance = cv2.distanceTransform(beside.numpy(), cv2.DIST_L2, cv2.DIST_MASK_3)
    return wp.array(distance, dtype=wp.float32, device=device, copy=False)


def compute_chamfer_distance(beside: wp.array, device: str) -> wp.array:
    """Compute the chamfer distance (h, w) [pixel] from pixels where `beside` is 0, up to `CHAMFER_RADIUS`."""
    aside = wp.empty(beside.shape, dtype=wp.int32, device=device)
    distance = wp.empty(beside.shape, dtype=wp.float32, device=device)
    launch_in_bands(find_aside, [beside], [aside], beside.size, device)
    launch_in_bands(find_distance, [aside], [distance], beside.size, device)
    return distance


@forward_kernel
def find_edge(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    nearest: wp.array2d(dtype=wp.uint64),
    # output
    beside: wp.array2d(dtype=wp.uint8),
):
    """Mark each pixel: 0 if a surface is visible there but not at one of its four neighbours, else 1."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        row = index / nearest.shape[1]
        column = index - row * nearest.shape[1]
        within = wp.uint8(1)
        if nearest[row, column] != EMPTY_PIXEL:
            up = nearest[wp.max(row - 1, 0), column] == EMPTY_PIXEL
            down = nearest[wp.min(row + 1, nearest.shape[0] - 1), column] == EMPTY_PIXEL
            left = nearest[row, wp.max(column - 1, 0)] == EMPTY_PIXEL
            right = nearest[row, wp.min(column + 1, nearest.shape[1] - 1)] == EMPTY_PIXEL
            if up or down or left or right:
                within = wp.uint8(0)
        beside[row, column] = within


@forward_kernel
def find_aside(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    beside: wp.array2d(dtype=wp.uint8),
    # output
    aside: wp.array2d(dtype=wp.int32),
):
    """Compute the distance in columns of each pixel from the edge in its own row, at most `CHAMFER_RADIUS`."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        row = index / beside.shape[1]
        column = index - row * beside.shape[1]
        least = wp.int32(CHAMFER_RADIUS)
        for other in range(wp.max(column - CHAMFER_RADIUS, 0), wp.min(column + CHAMFER_RADIUS + 1, beside.shape[1])):
            if beside[row, other] == wp.uint8(0):
                least = wp.min(least, wp.abs(other - column))
        aside[row, column] = least


@forward_kernel
def find_distance(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    aside: wp.array2d(dtype=wp.int32),
    # output
    distance: wp.array2d(dtype=wp.float32),
):
    """Compute the chamfer distance: shortest path of straight and diagonal steps from each row's nearest pixel."""
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        row = index / aside.shape[1]
        column = index - row * aside.shape[1]
        least = wp.float32(2 * CHAMFER_RADIUS)
        for other in range(wp.max(row - CHAMFER_RADIUS, 0), wp.min(row + CHAMFER_RADIUS + 1, aside.shape[0])):
            away = wp.abs(other - row)
            slanted = wp.min(away, aside[other, column])
            straight = wp.max(away, aside[other, column]) - slanted
            least = wp.min(least, STRAIGHT_STEP * wp.float32(straight) + DIAGONAL_STEP * wp.float32(slanted))
        distance[row, column] = least


@wp.func
def smooth_distance(
    row: wp.int32, column: wp.int32, away: wp.array2d(dtype=wp.float32), nearest: wp.array2d(dtype=wp.uint64)
) -> wp.float32:
    """Signed distance of a pixel from the silhouette, below 0 inside: mean of nine pixels, which hides steps."""
    total = wp.float32(0.0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            y = wp.clamp(row + i, 0, away.shape[0] - 1)
            x = wp.clamp(column + j, 0, away.shape[1] - 1)
            total += wp.where(nearest[y, x] == EMPTY_PIXEL, away[y, x], -away[y, x])
    return total / 9.0


@wp.func
def over(line: wp.vec4ub, light: wp.vec3f) -> wp.vec3f:
    """Blend a line (colour times coverage, and coverage) over light."""
    left = 1.0 - wp.float32(line[3]) / 255.0
    return left * light + wp.vec3f(wp.float32(line[0]), wp.float32(line[1]), wp.float32(line[2]))


@wp.func
def shining(
    p: wp.vec3d,
    key: wp.uint64,
    q: wp.array2d(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.vec3i),
    looks: wp.array(dtype=wp.vec4f),
    surface: wp.float32,
) -> wp.vec3f:
    """Compute the light of a hidden surface at a pixel p = (u, v, 1), through the ground at depth `surface` [m].

    0 where there is none.
    """
    t = triangles[face_of(key)]
    w = weights_of(p, q[0, t[0]], q[0, t[1]], q[0, t[2]])
    look = w[0] * looks[t[0]] + w[1] * looks[t[1]] + w[2] * looks[t[2]]
    under = wp.float32(0.0)
    if surface > 0.0:
        under = wp.max(depth_of(key) - surface, 0.0)
    return 1.1 * (0.25 + 0.75 * wp.abs(look[0])) * wp.exp(-under / FADE_DEPTH) * wp.vec3f(look[1], look[2], look[3])


@wp.func
def strength(under: wp.float32) -> wp.float32:
    """Strength of the depth style's tint, at a depth under the ground [m]."""
    share = wp.clamp(wp.floor(under / DEPTH_STEP) / wp.float32(DEPTH_STEP_COUNT - 1), 0.0, 1.0)
    return MAX_TINT_OPACITY - (MAX_TINT_OPACITY - MIN_TINT_OPACITY) * share


@forward_kernel
def lay_over(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    top: wp.int32,
    left: wp.int32,
    width: wp.int32,
    nearest: wp.array2d(dtype=wp.uint64),
    q: wp.array2d(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.vec3i),
    pixels: wp.array3d(dtype=wp.vec2d),
    away: wp.array2d(dtype=wp.float32),
    looks: wp.array(dtype=wp.vec4f),
    depth: wp.array2d(dtype=wp.float32),
    segmentation: wp.array2d(dtype=wp.uint8),
    roles: wp.array(dtype=wp.uint8),
    front: wp.array2d(dtype=wp.uint8),
    shade: wp.int32,
    outlined: wp.bool,
    ink: wp.vec3f,
    under: wp.array(dtype=wp.vec4ub),
    above: wp.array(dtype=wp.vec4ub),
    # outputs
    ground: wp.array2d(dtype=wp.vec3ub),
    taken: wp.array2d(dtype=wp.uint8),
):
    """Composite pixels begin .. end - 1 of the box; `away` is the distance of each from the silhouette's edge [pixel].

    `looks` of the hidden surface's vertices: cosine of their normals to the optical axis, and colour in 0 .. 255.
    """
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        row = index / width
        column = index - row * width
        y = top + row
        x = left + column
        role = wp.int32(roles[wp.int32(segmentation[y, x])])
        free = role != FRONT
        if front.shape[0] > 0 and front[y, x] != wp.uint8(0):
            free = False
        through = role != CLOSED_GROUND
        key = nearest[row, column]
        inside = through and key != EMPTY_PIXEL
        window = wp.float32(0.0)
        if shade == WINDOW_SHADING and through:
            window = wp.where(
                inside, 1.0, wp.clamp(1.25 - 1.25 * away[row, column] / wp.float32(SOFT_EDGE_WIDTH), 0.0, 1.0)
            )
        # Coverage by the outline's dark rim, and by its ink.
        rim = wp.float32(0.0)
        line = wp.float32(0.0)
        if outlined and through and away[row, column] < MAX_EDGE_DISTANCE:
            far = wp.abs(smooth_distance(row, column, away, nearest))
            rim = wp.clamp(HALF_BORDER_WIDTH + 0.5 - far, 0.0, 1.0)
            line = wp.clamp(HALF_LINE_WIDTH + 0.5 - far, 0.0, 1.0)
        low = wp.vec4ub(wp.uint8(0))
        high = wp.vec4ub(wp.uint8(0))
        if under.shape[0] > 0:
            low = under[index]
        if above.shape[0] > 0:
            high = above[index]
        lined = rim > 0.0 or low[3] > wp.uint8(0) or high[3] > wp.uint8(0)
        taken[row, column] = wp.uint8(wp.where(lined and free, 1, 0))
        if free and (lined or window > 0.0 or (shade > WINDOW_SHADING and inside)):
            was = ground[y, x]
            light = wp.vec3f(wp.float32(was[0]), wp.float32(was[1]), wp.float32(was[2]))
            if shade == WINDOW_SHADING:
                light *= 1.0 - 0.62 * window * window * (3.0 - 2.0 * window)
                if inside:
                    p = pixel_at(0, column, row, pixels)
                    light += shining(p, key, q, triangles, looks, depth[y, x])
            light = wp.min(light, wp.vec3f(255.0))
            if inside and shade == TINT_SHADING:
                light = 0.55 * light + 0.45 * ink
            if inside and shade == DEPTH_SHADING:
                light += strength(depth_of(key) - depth[y, x]) * (ink - light)
            light = over(low, light)
            light = (1.0 - rim) * light + rim * BORDER_INK
            light = (1.0 - line) * light + line * ink
            light = over(high, light)
            ground[y, x] = wp.vec3ub(wp.uint8(light[0]), wp.uint8(light[1]), wp.uint8(light[2]))
