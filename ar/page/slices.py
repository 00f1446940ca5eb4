"""Axial, coronal and sagittal slices of a scan through a point, with the outlines of surfaces."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from ..overlay.composite import BROKEN_STROKES, DOUBTFUL_COLOUR, MARGIN_STROKES
from ..overlay.hud import TEXT_SCALE, WHITE, format_bound, name_direction, write_text
from ..overlay.marks import BEFORE_COLOUR, BEFORE_STROKES
from ..overlay.outlines import average_colour, draw_dashes
from ..rendering.layer import Layer, Solid

HALF_VIEW = 40e-3  # Half the side of a view [m].
VIEW_SIDE = 280  # Side of a view [pixel].
SAMPLING_DISTANCE = 0.8e-3  # Sampling distance of the scan [m]; a finer one shows no more detail.
OUTSIDE_GREY = 26  # Grey level outside the scan.
MAX_GREY = 190.0  # Maximum grey level of the scan, so that lines stand out.
BAND_OPACITY = 0.22  # Opacity of the error band.
EDGE_GREY = 90  # Grey level of the line between two views.
COARSE_SPACING = 7  # Grid spacing of the distances for the band [pixel]; linear interpolation between.
BAR_LENGTH = 20e-3  # Length of the scale bar [m].
PLANE_TOLERANCE = 1e-3  # Maximum distance of a tip that counts as in the plane [m].
EDGE_DISTANCE = 8  # Distance of letters, names and the bar from the edge [pixel].
SUBPIXEL_BITS = 4  # Number of binary digits of subpixel positions of outlines.


@dataclass(frozen=True)
class SliceView:
    """View along a RAS axis, with unit vectors (3,) to the right and downwards."""

    name: str
    right: tuple[float, float, float]
    down: tuple[float, float, float]

    @property
    def normal(self) -> np.ndarray:
        """Viewing direction (3,), pointing away from the viewer."""
        return np.cross(self.right, self.down)

    def compute_points(self, centre: np.ndarray, count: int) -> np.ndarray:
        """Compute positions (count, count, 3) [m] of a square pixel grid round `centre` (3,) [m], row by row."""
        steps = HALF_VIEW * ((2.0 * np.arange(count) + 1.0) / count - 1.0)
        return centre + steps[:, None, None] * np.asarray(self.down) + steps[None, :, None] * np.asarray(self.right)

    def project_points(self, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Project positions (n, 3) [m] to columns and rows (n, 2) of the view; integers are pixel centres."""
        off = (np.asarray(points) - centre) @ np.stack([self.right, self.down], axis=1)
        return (off / HALF_VIEW + 1.0) * (0.5 * VIEW_SIDE) - 0.5


PLANES = (
    SliceView("axial", (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    SliceView("coronal", (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    SliceView("sagittal", (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
)
"""Views in radiological convention, with the patient's right on the left side."""


@dataclass(frozen=True, eq=False)
class SlicedSurfaces:
    """Surfaces whose outlines are drawn in the slices.

    Parameters
    ----------
    current, initial
        Tumour surface, as deformed now and as in the scan.
    error
        Bound [m] on the distance of every surface point from its true position, at 95 %; None: not available.
    is_unreliable
        True if the position is unreliable; the outline is then amber and broken, without an error band.
    others
        Further surfaces, such as the tool, drawn as solid lines in their colours.
    tip
        Contact position (3,) [m] of the tool; None: no tool.
    error_source
        Name of the source of the error, in one word.
    """

    current: Layer
    initial: Layer
    error: float | None = None
    is_unreliable: bool = False
    others: Sequence[Layer] = ()
    tip: np.ndarray | None = None
    error_source: str = "tumour"


def draw_slices(scan: Solid | None, centre: np.ndarray, layers: SlicedSurfaces) -> np.ndarray:
    """Draw three views side by side, (VIEW_SIDE, 3 VIEW_SIDE, 3) uint8, through `centre` (3,) [m].

    If `scan` is None, the background is plain.
    """
    return np.concatenate([draw_view(plane, scan, np.asarray(centre, np.float64), layers) for plane in PLANES], axis=1)


def draw_view(plane: SliceView, scan: Solid | None, centre: np.ndarray, layers: SlicedSurfaces) -> np.ndarray:
    """Draw one view (VIEW_SIDE, VIEW_SIDE, 3) uint8, with its lines and text."""
    grey = (
        np.full((VIEW_SIDE, VIEW_SIDE), OUTSIDE_GREY, np.uint8) if scan is None else resample_view(plane, scan, centre)
    )
    colour = np.repeat(grey[..., None], 3, axis=2)
    ink = average_colour(
        DOUBTFUL_COLOUR
        if layers.is_unreliable
        else layers.current.colour
        if len(layers.current.vertices)
        else BEFORE_COLOUR
    )
    if layers.error is not None and not layers.is_unreliable:
        inside = find_pixels_within(plane, centre, layers.current, layers.error)
        colour[inside] = (1.0 - BAND_OPACITY) * colour[inside] + BAND_OPACITY * np.array(ink)
        edges = cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        draw_dashes(colour, list(edges), ink, MARGIN_STROKES, 1)
    for layer in layers.others:
        draw_strokes(colour, cut_by_plane(plane, layer, centre), average_colour(layer.colour))
    draw_dashes(
        colour,
        [to_pixel_line(line) for line in cut_by_plane(plane, layers.initial, centre)],
        average_colour(BEFORE_COLOUR),
        BEFORE_STROKES,
    )
    now = cut_by_plane(plane, layers.current, centre)
    if layers.is_unreliable:
        draw_dashes(colour, [to_pixel_line(line) for line in now], ink, BROKEN_STROKES)
    else:
        draw_strokes(colour, now, ink, 2)
    if layers.tip is not None:
        mark_tip(colour, plane, np.asarray(layers.tip), centre)
    label_view(colour, plane, centre)
    write_text(colour, describe_error_band(layers), (EDGE_DISTANCE, 4 * EDGE_DISTANCE + 6), TEXT_SCALE)
    colour[:, -1] = EDGE_GREY
    return colour


def describe_error_band(layers: SlicedSurfaces) -> str:
    """Describe the error band in a few words for the view."""
    if layers.is_unreliable or layers.error is None:
        return f"{layers.error_source}: not known"
    return f"{layers.error_source}: within {format_bound(layers.error, 1)}"


def resample_view(plane: SliceView, scan: Solid, centre: np.ndarray) -> np.ndarray:
    """Resample the scan in a view, (VIEW_SIDE, VIEW_SIDE) uint8; pixels outside the scan are `OUTSIDE_GREY`."""
    count = round(2.0 * HALF_VIEW / SAMPLING_DISTANCE)
    matrix = scan.T_index_world
    index = plane.compute_points(centre, count) @ matrix[:3, :3].T + matrix[:3, 3]
    held = ((index >= -0.5) & (index <= np.array(scan.values.shape) - 0.5)).all(axis=-1)
    read = np.zeros((count, count), np.float32)
    map_coordinates(scan.values, np.moveaxis(index, -1, 0), order=1, mode="nearest", output=read)
    large = cv2.resize(MAX_GREY * read, (VIEW_SIDE, VIEW_SIDE), interpolation=cv2.INTER_CUBIC)
    inside = cv2.resize(np.asarray(held, np.uint8), (VIEW_SIDE, VIEW_SIDE), interpolation=cv2.INTER_NEAREST) > 0
    return np.where(inside, np.clip(large, 0.0, 255.0), OUTSIDE_GREY).astype(np.uint8)


def find_pixels_within(plane: SliceView, centre: np.ndarray, layer: Layer, distance: float) -> np.ndarray:
    """Return the mask (VIEW_SIDE, VIEW_SIDE) of pixels within `distance` [m] of a surface, measured in 3-D."""
    count = VIEW_SIDE // COARSE_SPACING
    if not len(layer.triangles):
        return np.zeros((VIEW_SIDE, VIEW_SIDE), bool)
    corners = layer.vertices[layer.triangles]
    halves = 0.5 * (corners + np.roll(corners, 1, axis=1))
    samples = np.concatenate([layer.vertices, halves.reshape(-1, 3), corners.mean(axis=1)])
    far = distance + 4.0 * HALF_VIEW / count
    away = KDTree(samples).query(plane.compute_points(centre, count).reshape(-1, 3), distance_upper_bound=far)[0]
    grid = np.minimum(away, far).reshape(count, count)
    return cv2.resize(grid, (VIEW_SIDE, VIEW_SIDE), interpolation=cv2.INTER_LINEAR) <= distance


def cut_surface(vertices: np.ndarray, triangles: np.ndarray, point: np.ndarray, normal: np.ndarray) -> list[np.ndarray]:
    """Cut a surface by a plane; return the cut as lines (n, 3) [m]. A closed line ends at its start.

    `vertices` (V, 3) are in metres; the plane is given by `point` (3,) [m] and `normal` (3,).
    """
    height = (np.asarray(vertices) - point) @ normal
    above = height >= 0.0
    some = above[triangles]
    mixed = np.asarray(triangles)[some.any(axis=1) & ~some.all(axis=1)]
    if not len(mixed):
        return []
    edges = np.sort(np.stack([mixed, np.roll(mixed, -1, axis=1)], axis=2), axis=2)
    crossed = edges[above[edges[..., 0]] != above[edges[..., 1]]]
    unique, segments = np.unique(crossed, axis=0, return_inverse=True)
    start, end = unique.T
    share = (height[start] / (height[start] - height[end]))[:, None]
    points = (1.0 - share) * vertices[start] + share * vertices[end]
    return [points[line] for line in join_segments(segments.reshape(-1, 2))]


def join_segments(segments: np.ndarray) -> list[list[int]]:
    """Chain segments (n, 2) of point indices to lines of point indices; a closed line ends at its start."""
    beside: dict[int, list[int]] = defaultdict(list)
    for a, b in segments.tolist():
        beside[a].append(b)
        beside[b].append(a)
    lines = []
    # Start with the ends of open lines: the remaining lines are closed.
    for start in sorted(beside, key=lambda point: len(beside[point]) != 1):
        while beside[start]:
            line = [start]
            while beside[line[-1]]:
                after = beside[line[-1]].pop()
                beside[after].remove(line[-1])
                line.append(after)
            lines.append(line)
    return lines


def cut_by_plane(plane: SliceView, layer: Layer, centre: np.ndarray) -> list[np.ndarray]:
    """Cut a surface by a view's plane; return lines (n, 2) of columns and rows."""
    found = cut_surface(layer.vertices, layer.triangles, centre, plane.normal)
    return [plane.project_points(line, centre) for line in found]


def draw_strokes(image: np.ndarray, lines: Sequence[np.ndarray], colour: Sequence[float], width: int = 1) -> None:
    """Draw lines (n, 2) with subpixel accuracy into an image (H, W, 3), in place."""
    fine = [np.rint(line * 2**SUBPIXEL_BITS).astype(np.int32)[:, None] for line in lines]
    cv2.polylines(image, fine, False, tuple(colour), width, cv2.LINE_AA, SUBPIXEL_BITS)


def to_pixel_line(line: np.ndarray) -> np.ndarray:
    """Resample a line (n, 2) to pixels (m, 1, 2) int32 at a distance of one pixel, for `draw_dashes`."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    steps = np.arange(0.0, along[-1] + 1.0)
    at = np.stack([np.interp(steps, along, line[:, axis]) for axis in (0, 1)], axis=1)
    return np.rint(at).astype(np.int32)[:, None]


def mark_tip(image: np.ndarray, plane: SliceView, tip: np.ndarray, centre: np.ndarray) -> None:
    """Mark a tip (3,) [m] in place: with a dot if the tip is in the plane, else with a ring."""
    ((column, row),) = np.clip(plane.project_points(tip[None], centre), -1e4, 1e4).round().astype(int).tolist()
    beside = abs(float((tip - centre) @ plane.normal)) > PLANE_TOLERANCE
    cv2.circle(image, (column, row), 5, (12, 14, 16), 1 if beside else -1, cv2.LINE_AA)
    cv2.circle(image, (column, row), 4, WHITE, 1 if beside else -1, cv2.LINE_AA)


def label_view(image: np.ndarray, plane: SliceView, centre: np.ndarray) -> None:
    """Draw a view's name, position, orientation letters and scale bar, in place."""
    right, down = np.asarray(plane.right), np.asarray(plane.down)
    axis = int(np.argmax(np.abs(plane.normal)))
    write_text(
        image,
        f"{plane.name}  {'xyz'[axis]} {1e3 * centre[axis]:.0f} mm",
        (EDGE_DISTANCE, 2 * EDGE_DISTANCE + 4),
        TEXT_SCALE,
    )
    half = VIEW_SIDE // 2
    places = (
        (-right, (EDGE_DISTANCE, half)),
        (right, (VIEW_SIDE - 3 * EDGE_DISTANCE, half)),
        (-down, (half + 4 * EDGE_DISTANCE, 2 * EDGE_DISTANCE + 4)),
        (down, (half, VIEW_SIDE - EDGE_DISTANCE)),
    )
    for way, at in places:
        write_text(image, name_direction(way), at)
    length, row = round(0.5 * VIEW_SIDE * BAR_LENGTH / HALF_VIEW), VIEW_SIDE - EDGE_DISTANCE
    for ink, width in (((12, 14, 16), 4), (WHITE, 2)):
        cv2.line(image, (EDGE_DISTANCE, row), (EDGE_DISTANCE + length, row), ink, width)
    write_text(image, f"{1e3 * BAR_LENGTH:.0f} mm", (EDGE_DISTANCE, row - EDGE_DISTANCE), TEXT_SCALE)
