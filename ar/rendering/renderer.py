"""Renderer of layers to images, as seen by a camera under a lamp."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import warp as wp

from ..optics.camera import Camera, look_at
from .layer import Layer
from .lens_rasteriser import Undistortion, build_undistortion
from .parallel import launch_in_bands, load_modules
from .rasteriser import NEAR_PLANE, allocate_z_buffer, draw_triangles, find_covered_rows
from .shade import (
    HALF_SOFT_WIDTH,
    TILE_SIDE,
    WHITE_LEVEL,
    compute_shadow_depths,
    compute_shadow_positions,
    shade_pixels,
)
from .surfaces import LayerStack, Light, PlacedSurface, Shadow, place_vertices

DRAPE_COLOUR = (0.13, 0.30, 0.36)  # Colour of the drape (RGB, scene-linear).
SHADOW_PIXELS = 384  # Side of the shadow map [pixel].


@dataclass(frozen=True, eq=False)
class Pictures:
    """Images of several cameras, on the device that rendered them; `.numpy()` of an array copies it to the host.

    `colour` (B, H, W) vec3ub is (B, H, W, 3) uint8 in NumPy. `depth` (B, H, W) float32 [m] and `segmentation` (B, H, W)
    uint8 are as in `Picture`.
    """

    colour: wp.array
    depth: wp.array
    segmentation: wp.array

    @property
    def arrays(self) -> tuple[wp.array, wp.array, wp.array]:
        """The arrays colour, depth and segmentation."""
        return self.colour, self.depth, self.segmentation


@dataclass(frozen=True, eq=False)
class Picture:
    """Image of one camera; its arrays are copied from the device on first use."""

    drawn: Pictures

    @cached_property
    def colour(self) -> np.ndarray:
        """Colour (H, W, 3) uint8, sRGB."""
        return self.drawn.colour.numpy()[0]

    @cached_property
    def depth(self) -> np.ndarray:
        """Depth (H, W) float32 [m]: z in the camera frame, 0 without a surface."""
        return self.drawn.depth.numpy()[0]

    @cached_property
    def segmentation(self) -> np.ndarray:
        """Id (H, W) uint8 of the visible layer, 0 without a surface."""
        return self.drawn.segmentation.numpy()[0]


@dataclass(frozen=True, eq=False)
class StaticBackground:
    """Image of the fixed layers for one camera, without shadows, to draw moving layers on.

    `surface` has the vertices of all layers when `z_buffer` was drawn. `shadow_positions` (H W) is the position of each
    pixel in the shadow map.
    """

    camera: Camera
    z_buffer: wp.array
    surface: PlacedSurface
    images: Pictures
    shadow_positions: wp.array


@dataclass(frozen=True, eq=False)
class Lamp:
    """Surgical lamp: a spot light with a soft edge.

    `position` and `target` (3,), and the lit circle's `radius` at the target, are in metres; the light is scene-linear.
    """

    position: np.ndarray
    target: np.ndarray
    radius: float
    strength: float = 1.0
    ambient: float = 0.16

    def build_camera(self) -> Camera:
        """Return the camera at the lamp's position, with which the shadow map is drawn."""
        axis = np.asarray(self.target) - self.position
        angle = np.arctan(self.radius / np.linalg.norm(axis))
        side = np.eye(3)[np.argmin(np.abs(axis))]
        return look_at(np.asarray(self.position), self.target, side, 2.0 * angle, SHADOW_PIXELS, SHADOW_PIXELS)

    camera = build_camera  # Former names, for one release.


def build_lamp(camera: Camera, target: np.ndarray, radius: float = 0.06) -> Lamp:
    """Build a lamp above and left of the camera, aimed at `target` (3,) [m], so that shadows fall next to the tool."""
    distance = np.linalg.norm(np.asarray(target) - camera.centre)
    right, down = camera.T_camera_world[0, :3], camera.T_camera_world[1, :3]
    return Lamp(camera.centre - distance * (0.45 * right + 0.3 * down), np.asarray(target), radius)


def render(camera: Camera, layers: Sequence[Layer], lamp: Lamp, device: str = "cpu") -> Picture:
    """Render layers as seen by a camera under a lamp; to render the same layers repeatedly, use a `Renderer`.

    Raises
    ------
    ValueError
        Layers of different names have the same id.

    Examples
    --------
    >>> from ar import Layer, build_lamp, look_at, render
    >>> layer = Layer("cortex", 1, 0.1 * np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    >>> camera = look_at(np.array([0.0, 0.0, 0.4]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    >>> image = render(camera, [layer], build_lamp(camera, target=np.zeros(3)))
    >>> image.colour.shape, int(image.segmentation[240, 320]), round(float(image.depth[240, 320]), 1)
    ((480, 640, 3), 1, 0.4)
    """
    return Renderer(layers, lamp, device).render(camera, [layer.vertices for layer in layers if not layer.still])


class Renderer:
    """Renderer of layers under a lamp: prepared once, used for any number of images, from one thread at a time.

    If the same camera is used again, the image of the fixed layers is cached, starting with its second image.
    """

    def __init__(self, layers: Sequence[Layer], lamp: Lamp, device: str = "cpu") -> None:
        """Copy the layers to a Warp device; ValueError if layers of different names have the same id."""
        load_modules(device, shade_pixels.module, place_vertices.module)
        self.device, self.stack = device, LayerStack(layers, device)
        self.light, self.lamp_camera = to_light(lamp), lamp.build_camera()
        self.curve = wp.array(build_tone_curve(), dtype=wp.uint8, device=device)
        self.unshaded = wp.empty(0, dtype=wp.vec3i, device=device)
        self.nowhere = wp.empty(0, dtype=wp.vec3f, device=device)
        self.seen_by: Camera | None = None
        self.backdrop: StaticBackground | None = None

    def render(self, camera: Camera, vertices: Sequence[np.ndarray]) -> Picture:
        """Render the image of a camera; `vertices` are those (V, 3) [m] of each moving layer, in order.

        Raises
        ------
        ValueError
            The vertices have other shapes than the layers.
        """
        moved = self.stack.copy_vertices(np.concatenate([np.zeros((0, 3)), *vertices])[None])
        stays, self.seen_by = camera is self.seen_by, camera
        backdrop = self._get_background(camera, moved) if stays and self.stack.still_faces else None
        return Picture(self._draw_all([camera], moved, backdrop))

    def render_batch(self, vertices: np.ndarray | wp.array, cameras: Sequence[Camera]) -> Pictures:
        """Render images of cameras of equal size; the images remain on the device.

        Parameters
        ----------
        vertices
            Vertices (B, n, 3) [m] of all moving layers, one layer after the other, for each image. A Warp array (B, n)
            of `vec3d` on this device is used without a copy, and must be finite.
        cameras
            B cameras, or one camera for all images.

        Raises
        ------
        ValueError
            Shapes are wrong, the number of cameras is neither 1 nor B, or cameras have different sizes.
        """
        moved = self.stack.copy_vertices(vertices)
        count = moved.shape[0]
        if len(cameras) not in (1, count):
            raise ValueError(f"{len(cameras)} cameras for {count} images: give one for each, or one for all.")
        if len({(camera.width, camera.height) for camera in cameras}) > 1:
            raise ValueError("the cameras have several sizes: draw those of each size together.")
        return self._draw_all([*cameras] * (count // len(cameras)), moved, None)

    def _draw_all(self, cameras: Sequence[Camera], vertices: wp.array, background: StaticBackground | None) -> Pictures:
        """Draw the image of each camera, on the static background if given."""
        count, height, width = len(cameras), cameras[0].height, cameras[0].width
        if count * max(height * width, SHADOW_PIXELS**2) >= 2**31:
            raise ValueError(f"{count} images of {width} x {height} are too many at once: draw fewer.")
        stack, vertex, face = self.stack, 0, 0
        if background is None:
            nearest, placed = allocate_z_buffer(count, height, width, self.device), stack.allocate_placed(count)
            pictures, lit_at = allocate_images(count, height, width, self.device), self.nowhere
        else:
            vertex, face, lit_at = stack.still_vertices, stack.still_faces, background.shadow_positions
            nearest, placed = wp.clone(background.z_buffer), copy_surface(background.surface)
            pictures = Pictures(*(wp.clone(array) for array in background.images.arrays))
        self._place(cameras, vertices, placed, vertex)
        through = build_undistortion(cameras, self.device)
        rows = slice(0, height) if through.pixels.size else self._find_rows(placed.camera_points, vertex, height)
        draw_triangles(
            placed.camera_points, stack.surfaces.triangles, face, rows, nearest, self.device, undistortion=through
        )
        self._shade_images(cameras, placed, nearest, stack.casting, face, lit_at, through, pictures)
        return pictures

    def _shade_images(
        self, cameras: Sequence[Camera], surface: PlacedSurface, z_buffer: wp.array, casting: wp.array, still: int,
        shadow_positions: wp.array, undistortion: Undistortion, images: Pictures,
    ) -> None:  # fmt: skip
        """Shade the pixels of z-buffers into images with a background; `casting` triangles cast shadows."""
        count, height, width = z_buffer.shape
        shadow = self._draw_shadow(surface, casting)
        inputs = [
            width, height * width, z_buffer.flatten(), self.stack.surfaces, surface, self._get_centres(cameras),
            self.light,
            shadow, self.curve, still, shadow_positions, undistortion.pixels,
        ]  # fmt: skip
        outputs = [array.flatten() for array in images.arrays]
        launch_in_bands(shade_pixels, inputs, outputs, count * height * width, self.device, per_core=4)

    def _place(self, cameras: Sequence[Camera], vertices: wp.array, surface: PlacedSurface, first_vertex: int) -> None:
        """Place the vertices from index `first_vertex` on in each image."""
        stack = self.stack
        matrices = wp.array([compute_projection(camera) for camera in cameras], dtype=wp.mat44d, device=self.device)
        inputs = [
            first_vertex, stack.still, vertices, matrices, wp.mat44d(compute_projection(self.lamp_camera)),
            stack.surfaces.triangles,
            stack.around, stack.faces,
        ]  # fmt: skip
        launch_in_bands(place_vertices, inputs, [surface], len(cameras) * (stack.vertices - first_vertex), self.device)

    def _find_rows(self, camera_points: wp.array, first_vertex: int, height: int) -> slice:
        """Return the rows that vertices from `first_vertex` on may cover; on a GPU all rows, as a test takes longer."""
        if self.device != "cpu":
            return slice(0, height)
        return slice(*find_covered_rows(camera_points.numpy()[:, first_vertex:].reshape(-1, 3), NEAR_PLANE, height))

    def _draw_shadow(self, surface: PlacedSurface, casting_triangles: wp.array) -> Shadow:
        """Draw the shadow map of each image; return the maps."""
        count, tiles = surface.lamp_points.shape[0], SHADOW_PIXELS // int(TILE_SIDE)
        shadow = Shadow()
        shadow.size = SHADOW_PIXELS
        shadow.depth = wp.empty(count * SHADOW_PIXELS**2, dtype=wp.float32, device=self.device)
        shadow.bounds = wp.empty(count * tiles**2, dtype=wp.vec2f, device=self.device)
        nearest = allocate_z_buffer(count, SHADOW_PIXELS, SHADOW_PIXELS, self.device)
        draw_triangles(surface.lamp_points, casting_triangles, 0, slice(0, SHADOW_PIXELS), nearest, self.device)
        launch_in_bands(compute_shadow_depths, [nearest], [shadow], count * tiles**2, self.device)
        return shadow

    def _get_centres(self, cameras: Sequence[Camera]) -> wp.array:
        return wp.array([camera.centre for camera in cameras], dtype=wp.vec3f, device=self.device)

    def _get_background(self, camera: Camera, vertices: wp.array) -> StaticBackground:
        """Return the image of the fixed layers for a camera; the last one is cached."""
        if self.backdrop is not None and self.backdrop.camera is camera:
            return self.backdrop
        stack, height, width = self.stack, camera.height, camera.width
        placed, nearest = stack.allocate_placed(1), allocate_z_buffer(1, height, width, self.device)
        pictures = allocate_images(1, height, width, self.device)
        self._place([camera], vertices, placed, 0)
        there = stack.surfaces.triangles[: stack.still_faces]
        through = build_undistortion([camera], self.device)
        draw_triangles(placed.camera_points, there, 0, slice(0, height), nearest, self.device, undistortion=through)
        self._shade_images([camera], placed, nearest, self.unshaded, 0, self.nowhere, through, pictures)
        lit_at = wp.zeros(height * width, dtype=wp.vec3f, device=self.device)
        centres = self._get_centres([camera])
        inputs = [width, nearest.flatten(), stack.surfaces, placed, centres, self.light, through.pixels]
        launch_in_bands(compute_shadow_positions, inputs, [lit_at], height * width, self.device)
        self.backdrop = StaticBackground(camera, nearest, placed, pictures, lit_at)
        return self.backdrop

    picture, pictures = render, render_batch  # Former names, for one release.


def allocate_images(count: int, height: int, width: int, device: str) -> Pictures:
    """Allocate `count` images that show only the background."""
    shape = count, height, width
    colour = wp.empty(shape, dtype=wp.vec3ub, device=device)
    for row in range(count):
        wp.copy(colour[row], draw_background(width, height, device))
    depth = wp.zeros(shape, dtype=wp.float32, device=device)
    return Pictures(colour, depth, wp.zeros(shape, dtype=wp.uint8, device=device))


def copy_surface(surface: PlacedSurface) -> PlacedSurface:
    """Return a copy of a placed surface with all its arrays."""
    out = PlacedSurface()
    for name in ("camera_points", "lamp_points", "vertices", "normals"):
        setattr(out, name, wp.clone(getattr(surface, name)))
    return out


def compute_projection(camera: Camera) -> np.ndarray:
    """Compute the matrix (4, 4) from a world point (x, 1) [m] to homogeneous pixel coordinates (u w, v w, w, 1)."""
    P = np.eye(4)
    P[:3] = camera.K @ camera.T_camera_world[:3]
    return P


def to_light(lamp: Lamp) -> Light:
    """Convert a lamp to the struct that kernels use."""
    camera = lamp.build_camera()
    axis = np.asarray(lamp.target) - lamp.position
    light = Light()
    light.position, light.axis = wp.vec3f(lamp.position), wp.vec3f(axis / np.linalg.norm(axis))
    angle = np.arctan(lamp.radius / np.linalg.norm(axis))
    light.outer, light.steepness = float(np.cos(angle)), float(1.0 / (np.cos(0.55 * angle) - np.cos(angle)))
    light.strength, light.ambient, light.P = lamp.strength, lamp.ambient, wp.mat44f(compute_projection(camera))
    # The offset equals the filter width, so that the surface itself is never under the filter, at any slant.
    light.offset = float(1.05 * (HALF_SOFT_WIDTH + 0.5) * np.linalg.norm(axis) / camera.K[0, 0])
    return light


@lru_cache(maxsize=4)
def draw_background(width: int, height: int, device: str) -> wp.array:
    """Draw the background (H, W, 3) uint8, a drape that is brighter in the centre, on a device."""
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    fall = 1.0 - 0.45 * np.clip(np.hypot(x, y) / np.sqrt(2.0), 0.0, 1.0)
    return wp.array((255.0 * fall[..., None] * DRAPE_COLOUR).astype(np.uint8), dtype=wp.vec3ub, device=device)


@lru_cache(maxsize=1)
def build_tone_curve() -> np.ndarray:
    """Compute the table (4096,) uint8 from scene-linear light to displayed values: filmic (Narkowicz 2016), gamma 2."""
    x = np.linspace(0.0, float(WHITE_LEVEL), 4096)
    filmic = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)
    return (255.0 * np.sqrt(filmic) + 0.5).astype(np.uint8)
