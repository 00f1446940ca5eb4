"""Cross-section of a hidden surface in an inset: along the line of sight, through its centroid and the tool's tip.

The plane contains the camera's centre, so it appears in the image as a line, and all points seen on that line are in
the plane.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering.layer import Layer
from .distances import build_bvh, compute_signed_distance
from .hud import WHITE, write_text_with_halo
from .outlines import draw_dashes, find_outlines
from .window import CLOSED_GROUND, FRONT

# Smallest distance of a tip from the line of sight that defines the plane [m]; below it, the plane is horizontal.
MIN_TIP_DISTANCE = 1e-3
SURFACE_MARGIN = 12e-3  # Margin of the inset round the hidden surface [m].
TOP_MARGIN = 4e-3  # Margin of the inset above the visible surface, and round the tip [m].
MAX_DISTANCE = 60e-3  # Largest measured distance to the hidden surface [m].
TONE_WIDTH = 5e-3  # Width of a tone [m]; tissue is shaded by its distance from the surface.
# Colours of the tones (RGB), the closest to the surface first.
TONES = np.array([(222, 206, 192), (184, 168, 156), (146, 132, 124), (112, 100, 94), (82, 74, 70)], np.float64)
EMPTY_COLOUR = (20.0, 24.0, 27.0)
"""Colour of the inset above the visible surface (RGB)."""
CLOSED_COLOUR = (120.0, 165.0, 180.0)
"""Colour of the visible surface (RGB) where it is closed ground."""
INSET_TEXT_SCALE = 0.38  # Font scale of the inset's text.
INSET_LINE_SPACING = 14  # Line spacing of the inset's text [pixel].
INSET_STROKES = (5, 4)  # Stroke and gap lengths of the margin [pixel].
SCALE_BAR_LENGTH = 10e-3
"""Length of the scale bar [m]."""
END_LETTERS = ("a", "b")
"""Letters at the ends of the cutting line in the image, and at the left and right side of the inset."""
HALF_NUMBER_WIDTH = 10  # Half the width of a number [pixel].


@dataclass(frozen=True, eq=False)
class CutPlane:
    """Plane through `centre` (3,) [m]; unit vectors `along` and `across` (3,) are relative to the line of sight."""

    centre: np.ndarray
    across: np.ndarray
    along: np.ndarray

    def to_plane(self, points: np.ndarray) -> np.ndarray:
        """Convert points (..., 3) [m] in the plane to coordinates (..., 2) [m]: across and along the line of sight."""
        return (points - self.centre) @ np.stack([self.across, self.along], axis=1)

    def to_world(self, coordinates: np.ndarray) -> np.ndarray:
        """Convert plane coordinates (..., 2) [m] to points (..., 3) [m]."""
        return self.centre + coordinates @ np.stack([self.across, self.along])


def build_plane(camera: Camera, centre: np.ndarray, tip: np.ndarray | None) -> CutPlane:
    """Build the plane through the camera's centre, a surface's centre (3,) [m] and, if given, a tip (3,) [m].

    Without a tip, or with a tip on the line of sight, the plane is horizontal in the image. `across` points right.
    """
    along = (centre - camera.centre) / np.linalg.norm(centre - camera.centre)
    level = camera.T_camera_world[0, :3]
    towards = level if tip is None else tip - centre
    across = towards - (towards @ along) * along
    if np.linalg.norm(across) < MIN_TIP_DISTANCE:
        across = level - (level @ along) * along
    across /= np.linalg.norm(across)
    return CutPlane(centre, across if across @ level >= 0.0 else -across, along)


def compute_surface_profile(
    camera: Camera, plane: CutPlane, depth: np.ndarray, roles: np.ndarray, half_width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Extract the visible surface in the plane: positions (n, 2) [m], sorted across, and their roles (n,).

    `depth` (H, W) [m] and `roles` (H, W) uint8 belong to the image. Objects in front of the overlay are left out.
    Positions are searched up to `half_width` [m] across.
    """
    steps = np.linspace(-half_width, half_width, 4 * max(camera.width, 1))
    pixels, _ = camera.project(plane.to_world(np.stack([steps, 0.0 * steps], axis=1)))
    pixels = np.unique(pixels[np.isfinite(pixels).all(axis=1)].round().astype(int), axis=0)
    pixels = pixels[((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)]
    far, role = depth[pixels[:, 1], pixels[:, 0]], roles[pixels[:, 1], pixels[:, 0]]
    kept = (far > 0.0) & (role != FRONT)
    places = plane.to_plane(camera.unproject(pixels[kept], far[kept]))
    order = np.argsort(places[:, 0], kind="stable")
    return places[order], role[kept][order]


def draw_section(
    camera: Camera, layer: Layer, plane: CutPlane, profile: tuple[np.ndarray, np.ndarray], size: tuple[int, int],
    colour: tuple[float, ...], tip: np.ndarray | None = None, error: float | None = None,
) -> np.ndarray:  # fmt: skip
    """Draw the inset (h, w, 3) uint8: tissue shaded by its distance from the hidden surface, inside in `colour`.

    Parameters
    ----------
    profile
        Visible surface from `compute_surface_profile`.
    size
        Width and height of the inset [pixel].
    tip
        Tip of the tool (3,) [m], drawn as a dot; None: no dot.
    error
        Error bound [m] of the surface, drawn as a dashed line at this distance outside; None: no line.
    """
    wide, tall = size
    low, scale = _compute_inset_origin(plane, layer, profile[0], tip, size)
    columns, rows = np.meshgrid(np.arange(wide), np.arange(tall))
    places = low + np.stack([columns, rows], axis=2) / scale
    distance = compute_signed_distance(
        build_bvh(layer.vertices, layer.triangles), plane.to_world(places).reshape(-1, 3), MAX_DISTANCE
    ).reshape(tall, wide)
    tone = np.nan_to_num(distance / TONE_WIDTH, nan=len(TONES)).clip(0, len(TONES) - 1).astype(int)
    out = TONES[tone]
    out[distance < 0.0] = colour
    if len(profile[0]):
        out[places[..., 1] < np.interp(places[..., 0], profile[0][:, 0], profile[0][:, 1])] = EMPTY_COLOUR
    out = out.astype(np.uint8)
    if error is not None:
        draw_dashes(out, find_outlines(distance < error), colour, INSET_STROKES, 2)
    at = np.rint((profile[0] - low) * scale).astype(np.int32)
    for (column, row), role in zip(at.tolist(), profile[1].tolist(), strict=True):
        cv2.circle(out, (column, row), 1, (*(CLOSED_COLOUR if role == CLOSED_GROUND else WHITE), 255), -1)
    if tip is not None:
        column, row = np.rint((plane.to_plane(tip) - low) * scale).astype(int).tolist()
        cv2.circle(out, (column, row), 5, (10, 12, 12, 255), -1, cv2.LINE_AA)
        cv2.circle(out, (column, row), 3, (*WHITE, 255), -1, cv2.LINE_AA)
    _write_bands(out, distance, places, profile[0])
    for letter, column in zip(END_LETTERS, (4, wide - 12), strict=True):
        write_text_with_halo(out, letter, (column, 12), INSET_TEXT_SCALE)
    bar = round(SCALE_BAR_LENGTH * scale)
    cv2.line(out, (6, tall - 6), (6 + bar, tall - 6), (*WHITE, 255), 2)
    write_text_with_halo(out, f"{1e3 * SCALE_BAR_LENGTH:.0f} mm", (6, tall - 11), INSET_TEXT_SCALE)
    return out


def add_caption(inset: np.ndarray, lines: list[str]) -> np.ndarray:
    """Return an inset (h, w, 3) uint8 with lines of text below, and a thin frame."""
    foot = np.full((INSET_LINE_SPACING * len(lines) + 4, inset.shape[1], 3), np.array(EMPTY_COLOUR), np.uint8)
    for number, line in enumerate(lines):
        write_text_with_halo(foot, line, (5, INSET_LINE_SPACING * (number + 1) - 2), INSET_TEXT_SCALE)
    out = np.concatenate([inset, foot])
    cv2.rectangle(out, (0, 0), (out.shape[1] - 1, out.shape[0] - 1), (150, 154, 158, 255), 1)
    return out


def _compute_inset_origin(
    plane: CutPlane, layer: Layer, surface: np.ndarray, tip: np.ndarray | None, size: tuple[int, int]
) -> tuple[np.ndarray, float]:
    """Compute the plane coordinates (2,) [m] of the inset's upper left corner, and its scale [pixel/m]."""
    places = plane.to_plane(layer.vertices)
    held = [places.min(axis=0) - SURFACE_MARGIN, places.max(axis=0) + SURFACE_MARGIN]
    near = surface[(surface[:, 0] > held[0][0]) & (surface[:, 0] < held[1][0])]
    held += [near.min(axis=0) - TOP_MARGIN] if len(near) else []
    held += [] if tip is None else [plane.to_plane(tip) - TOP_MARGIN, plane.to_plane(tip) + TOP_MARGIN]
    low, high = np.min(held, axis=0), np.max(held, axis=0)
    scale = float((np.array(size) / (high - low)).min())
    return 0.5 * (low + high) - 0.5 * np.array(size) / scale, scale


def _write_bands(image: np.ndarray, distance: np.ndarray, positions: np.ndarray, surface: np.ndarray) -> None:
    """Write the distances [mm] at the borders of tones, near the centre row, on the side with more tissue; in place."""
    middle, wide = int(np.abs(positions[:, 0, 1]).argmin()), image.shape[1]
    for step in (1, 2, 3):
        row = min(max(middle + (step - 2) * INSET_LINE_SPACING, 0), len(image) - 1)
        tissue = np.ones(wide, bool)
        if len(surface):
            tissue = positions[row, :, 1] > np.interp(positions[row, :, 0], surface[:, 0], surface[:, 1])
        left = tissue[: wide // 2].sum() >= tissue[wide // 2 :].sum()
        columns = np.flatnonzero((distance[row] < step * TONE_WIDTH) & tissue)
        column = int(columns[0 if left else -1]) if len(columns) else 0
        if (
            HALF_NUMBER_WIDTH < column < wide - HALF_NUMBER_WIDTH
            and tissue[column - HALF_NUMBER_WIDTH : column + HALF_NUMBER_WIDTH].all()
        ):
            write_text_with_halo(
                image, f"{1e3 * step * TONE_WIDTH:.0f}", (column - HALF_NUMBER_WIDTH // 2, row + 4), INSET_TEXT_SCALE
            )
