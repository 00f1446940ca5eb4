"""Measuring styles of an overlay: rings on the ground, a cross-section in an inset, the scale of the depth tint."""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from ..optics.camera import Camera
from ..rendering.layer import Layer
from ..rendering.renderer import Picture
from .cut import END_LETTERS, CutPlane, add_caption, build_plane, compute_surface_profile, draw_section
from .distances import RING_COLOUR, RING_DISTANCES, build_bvh, compute_visible_distance, draw_rings
from .gauge import DistanceGauge
from .hud import HEAD_ROW, TEXT_SCALE, Hideable, format_bound, place_text, wrap_line, write_text_with_halo
from .legend import LEGEND_TEXT_SCALE, draw_depth_scale, paste_inset, place_inset
from .outlines import OPAQUE, average_colour, draw_dashes, shift_shade
from .styles import Style
from .text_placement import BORDER_DISTANCE, find_free_position
from .window import FRONT, LayerRoles

SEARCH_MARGIN = 3e-3  # Margin beyond the last ring for which distances are computed [m].
INSET_WIDTHS = (0.34, 0.27, 0.21)  # Widths of a cut's inset as shares of the image width; the first that fits is used.
INSET_ASPECT = 0.75  # Height of the inset over its width.
CUT_STROKES = (3, 5)  # Stroke and gap lengths of the cutting line in the image [pixel].
# Half-width of the search for the visible surface over a cut [half-widths of the hidden surface in the cut].
SEARCH_HALF_WIDTH = 4.0
LETTER_EDGE_DISTANCE = 12  # Distance of the cut's letters from the image border and from tools [pixel].
LETTER_LINE_DISTANCE = 10  # Distance of a letter from the cutting line [pixel].
HALF_LETTER_SIZE = 6  # Half the size of a letter [pixel].
NO_ROOM_TEXT = "no room for the cut"  # Text in the image if there is no space for the inset.


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measuring style applied to one image.

    Parameters
    ----------
    name
        Name of the hidden surface.
    error
        Error bound [m] of the surface; None if not available.
    """

    style: Style
    image: Picture
    camera: Camera
    layer: Layer
    roles: LayerRoles
    gauge: DistanceGauge | None = None
    name: str = ""
    error: float | None = None

    @property
    def error_text(self) -> str:
        """Text with the error bound of the measured distances."""
        return "error not known" if self.error is None else f"error {format_bound(self.error, 1)} (95 %)"

    @property
    def extent(self) -> np.ndarray:
        """Points (n, 3) [m] whose box in the image contains the rings; no points for other styles."""
        low, high = self.layer.vertices.min(axis=0), self.layer.vertices.max(axis=0)
        if self.style != "rings":
            return np.stack([low, high])[:0]
        beyond = RING_DISTANCES[-1] + SEARCH_MARGIN
        return np.stack(np.meshgrid(*np.stack([low - beyond, high + beyond], axis=1)), axis=-1).reshape(-1, 3)

    @property
    def plane(self) -> CutPlane:
        """Plane of the cross-section."""
        middle = self.layer.vertices.mean(axis=0)
        return build_plane(self.camera, middle, None if self.gauge is None else self.gauge.tip)

    def draw(self, canvas: np.ndarray, top_canvas: np.ndarray, box: tuple[slice, slice]) -> None:
        """Draw the rings, or the cutting line, in place on the canvas of the image part `box`.

        Letters of the cutting line are drawn on `top_canvas`, over all lines.
        """
        if self.style == "rings":
            free = self.roles.read_roles(self.image.segmentation, box) == 0
            tree = build_bvh(self.layer.vertices, self.layer.triangles, str(self.image.drawn.depth.device))
            reach = RING_DISTANCES[-1] + SEARCH_MARGIN
            draw_rings(
                canvas,
                compute_visible_distance(tree, self.camera, box, self.image.drawn.depth[0], free, reach),
                free & (canvas[..., 3] == 0) & (top_canvas[..., 3] == 0),
            )
        if self.style == "cut":
            plane, part = self.plane, self.camera.crop_to(*box)
            far = 1.45 * float(np.abs(plane.to_plane(self.layer.vertices)[:, 0]).max())
            steps = np.linspace(-far, far, 2 * part.width)
            pixels, _ = part.project(plane.to_world(np.stack([steps, 0.0 * steps], axis=1)))
            line = pixels[np.isfinite(pixels).all(axis=1)].round().astype(np.int32)
            line = line[np.diff(line, axis=0, append=-1).any(axis=1)]
            lines = np.ascontiguousarray(canvas[..., 3] > 0).astype(np.uint8)
            draw_dashes(canvas, [line[:, None]], RING_COLOUR, CUT_STROKES, 1)
            line = line[
                (
                    (line >= LETTER_EDGE_DISTANCE)
                    & (line < (part.width - LETTER_EDGE_DISTANCE, part.height - LETTER_EDGE_DISTANCE))
                ).all(axis=1)
            ]
            # Place letters where no tool covers the line.
            front = (self.roles.read_roles(self.image.segmentation, box) == FRONT).astype(np.uint8)
            line = line[
                cv2.dilate(front, np.ones((2 * LETTER_EDGE_DISTANCE + 1,) * 2, np.uint8))[line[:, 1], line[:, 0]] == 0
            ]
            if len(line):
                # Place letters next to the line, as the gauge's line from the tip may be on it.
                along = (line[-1] - line[0]) / max(float(np.linalg.norm(line[-1] - line[0])), 1.0)
                beside = np.rint(LETTER_LINE_DISTANCE * np.array([along[1], -along[0]])).astype(int)
                places = np.clip(
                    line + beside,
                    LETTER_EDGE_DISTANCE,
                    (part.width - LETTER_EDGE_DISTANCE, part.height - LETTER_EDGE_DISTANCE),
                )
                # Prefer places that hide no other line.
                clear = (
                    cv2.dilate(lines, np.ones((2 * HALF_LETTER_SIZE + 1,) * 2, np.uint8))[places[:, 1], places[:, 0]]
                    == 0
                )
                places = places[clear] if clear.any() else places
                for letter, (column, row) in zip(END_LETTERS, places[[0, -1]].tolist(), strict=True):
                    write_text_with_halo(top_canvas, letter, (column - 4, row + 4), TEXT_SCALE, RING_COLOUR)

    def draw_insets(self, image: np.ndarray, occupied: np.ndarray, obstacles: np.ndarray, required: np.ndarray) -> None:
        """Add the style's scale, text or inset to an image, in place; the other arguments are as in `place_inset`.

        `required` (H, W) uint8 is above 0 at objects that an inset must not cover even if there is no other space.
        """
        width = occupied.shape[1]
        if self.style == "depth":
            caption = f"{self.name or 'surface'}: mm under\nwhat is seen\n{self.error_text}"
            scale = draw_depth_scale(shift_shade(average_colour(self.layer.colour)), caption)
            if not place_inset(image, occupied, scale, obstacles):
                # A tint needs a scale, which may cover cortex if there is no free space.
                wish = image.shape[1], HEAD_ROW
                places = (
                    find_free_position(shut, scale.shape[1::-1], wish)
                    for shut in (occupied | obstacles, occupied | required, occupied)
                )
                place = next((each for each in places if each is not None), None)
                if place is not None:
                    paste_inset(image, occupied, scale, place)
        if self.style == "rings":
            said = f"rings: mm to the {self.name or 'surface'}; {self.error_text}"
            place_text(image, occupied, wrap_line(said, 0.3 * width), (width, HEAD_ROW), parts=Hideable(obstacles))
        if self.style == "cut":
            self._draw_cut(image, occupied, obstacles, required)

    def _draw_cut(self, image: np.ndarray, occupied: np.ndarray, obstacles: np.ndarray, required: np.ndarray) -> None:
        roles = self.roles.read_roles(self.image.segmentation)
        plane = self.plane
        reach = SEARCH_HALF_WIDTH * float(np.abs(plane.to_plane(self.layer.vertices)[:, 0]).max())
        seen = compute_surface_profile(self.camera, plane, self.image.depth, roles, reach)
        tip = None if self.gauge is None else self.gauge.tip
        ink = shift_shade(average_colour(self.layer.colour))
        for shut, share in itertools.product((occupied | obstacles, occupied | required), INSET_WIDTHS):
            wide = round(share * occupied.shape[1])
            lines = [
                line
                for text in (f"cut: mm to the {self.name or 'surface'}", self.error_text)
                for line in wrap_line(text, wide - BORDER_DISTANCE, LEGEND_TEXT_SCALE)
            ]
            inset = add_caption(np.zeros((round(INSET_ASPECT * wide), wide, 3), np.uint8), lines)
            shut[-HEAD_ROW:] = 1  # for the text at the bottom
            place = find_free_position(shut, inset.shape[1::-1], (occupied.shape[1], HEAD_ROW))
            if place is not None:
                drawn = draw_section(
                    self.camera, self.layer, plane, seen, (wide, round(INSET_ASPECT * wide)), ink, tip, self.error
                )
                whole = add_caption(drawn, lines)
                paste_inset(image, occupied, np.dstack([whole, np.full(whole.shape[:2], OPAQUE, np.uint8)]), place)
                return
        place_text(image, occupied, [NO_ROOM_TEXT], (occupied.shape[1], HEAD_ROW))
