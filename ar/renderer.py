"""Surfaces and a camera in, a lit picture out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp

from .camera import Camera, look_at
from .layer import Layer
from .parallel import launch_in_bands
from .place import place
from .rasteriser import NEAR, draw, empty_buffer, rows_reached
from .shade import BRIGHTEST, SOFT, TILE, Light, Placed, Shadow, Still, bound, remember, shade
from .surfaces import Stack

DRAPE = (0.13, 0.30, 0.36)
SHADOW_PIXELS = 384


@dataclass(frozen=True, eq=False)
class Picture:
    """What the camera sees.

    Parameters
    ----------
    colour
        (H, W, 3) uint8, sRGB.
    depth
        (H, W) float32 [m]: z in the camera frame, 0 where nothing is seen.
    segmentation
        (H, W) uint8: the id of the layer seen, 0 where nothing is seen.
    taken
        (H, W) uint8: above 0 where lines and words are drawn over it.
    """

    colour: np.ndarray
    depth: np.ndarray
    segmentation: np.ndarray
    taken: np.ndarray


@dataclass(frozen=True, eq=False)
class Pictures:
    """What cameras see, on the device that drew it; `.numpy()` of an array brings it here.

    colour (B, H, W, 3) uint8, depth (B, H, W) float32 [m] and segmentation (B, H, W) uint8 are as in `Picture`.
    """

    colour: wp.array
    depth: wp.array
    segmentation: wp.array


@dataclass(frozen=True, eq=False)
class Backdrop:
    """What one camera sees of the layers that stand still, and where all layers were when it was drawn."""

    camera: Camera
    nearest: wp.array
    placed: Placed
    still: Still

    def copied(self) -> Placed:
        """Where all layers were, in arrays that may be changed."""
        placed = Placed()
        for name in ("seen", "lit", "vertices", "normals"):
            setattr(placed, name, wp.clone(getattr(self.placed, name)))
        return placed


@dataclass(frozen=True, eq=False)
class Lamp:
    """A surgical lamp: a spot with a soft rim.

    position, target (3,) [m]; radius [m] of the lit circle at the target; strength and ambient light, scene-linear.
    """

    position: np.ndarray
    target: np.ndarray
    radius: float
    strength: float = 1.0
    ambient: float = 0.16

    def camera(self) -> Camera:
        """The view from the lamp, in which shadows are found."""
        axis = np.asarray(self.target) - self.position
        angle = np.arctan(self.radius / np.linalg.norm(axis))
        side = np.eye(3)[np.argmin(np.abs(axis))]
        return look_at(np.asarray(self.position), self.target, side, 2.0 * angle, SHADOW_PIXELS, SHADOW_PIXELS)


def lamp_beside(camera: Camera, target: np.ndarray, radius: float = 0.06) -> Lamp:
    """A lamp above the camera's left shoulder, on `target` (3,) [m]: shadows fall beside the tool, not under it."""
    distance = np.linalg.norm(np.asarray(target) - camera.centre)
    right, down = camera.T_camera_world[0, :3], camera.T_camera_world[1, :3]
    return Lamp(camera.centre - distance * (0.45 * right + 0.3 * down), np.asarray(target), radius)


def render(camera: Camera, layers: Sequence[Layer], lamp: Lamp, device: str = "cpu") -> Picture:
    """Draw layers as seen by a camera under a lamp. Those who draw the same layers again make a `Renderer`.

    Raises
    ------
    ValueError
        Two layers with one id.
    """
    return Renderer(layers, lamp, device).picture(camera, [layer.vertices for layer in layers if not layer.still])


class Renderer:
    """Layers under a lamp, made ready once and drawn any number of times; from one thread at a time.

    What one camera sees of layers that stand still is drawn once.
    """

    def __init__(self, layers: Sequence[Layer], lamp: Lamp, device: str = "cpu") -> None:
        """Bring the layers to a Warp device; ValueError when two have one id."""
        wp.load_module(shade.module, device=device)
        wp.load_module(place.module, device=device)
        self.device, self.stack = device, Stack(layers, device)
        self.light, self.lamp_camera = as_light(lamp), lamp.camera()
        self.curve = wp.array(tone_curve(), dtype=wp.uint8, device=device)
        self.nothing = nothing_still(device)
        self.backdrop: Backdrop | None = None

    def picture(self, camera: Camera, vertices: Sequence[np.ndarray]) -> Picture:
        """What a camera sees; vertices (V, 3) [m]: of each layer that moves, in order.

        Raises
        ------
        ValueError
            Vertices of other shapes than the layers'.
        """
        moved = self.stack.moved(np.concatenate([np.zeros((0, 3)), *vertices])[None])
        drawn = self._drawn([camera], moved, self._backdrop(camera, moved) if self.stack.still_faces else None)
        colour, depth, segmentation = (array.numpy()[0] for array in (drawn.colour, drawn.depth, drawn.segmentation))
        return Picture(colour, depth, segmentation, np.zeros(segmentation.shape, np.uint8))

    def pictures(self, vertices: np.ndarray | wp.array, cameras: Sequence[Camera]) -> Pictures:
        """What cameras of one size see; nothing leaves the device.

        Parameters
        ----------
        vertices
            (B, n, 3) [m]: of all layers that move, one after the other, in each picture. A Warp array (B, n) of
            `vec3d` on this device is taken as it is, and must be finite.
        cameras
            B of them, or one for all pictures.

        Raises
        ------
        ValueError
            Other shapes, another number of cameras, or cameras of several sizes.
        """
        moved = self.stack.moved(vertices)
        count = moved.shape[0]
        if len(cameras) not in (1, count):
            raise ValueError(f"{len(cameras)} cameras for {count} pictures: give one for each, or one for all.")
        if len({(camera.width, camera.height) for camera in cameras}) > 1:
            raise ValueError("the cameras have several sizes: draw those of each size together.")
        return self._drawn([*cameras] * (count // len(cameras)), moved, None)

    def _drawn(self, cameras: Sequence[Camera], moved: wp.array, backdrop: Backdrop | None) -> Pictures:
        """Draw every picture, upon the backdrop if there is one."""
        stack, height, width = self.stack, cameras[0].height, cameras[0].width
        if len(cameras) * max(height * width, SHADOW_PIXELS**2) >= 2**31:
            raise ValueError(f"{len(cameras)} pictures of {width} x {height} are too many at once: draw fewer.")
        if backdrop is None:
            vertex, face, still, placed = 0, 0, self.nothing, stack.unplaced(len(cameras))
            nearest = empty_buffer(len(cameras), height, width, self.device)
        else:
            vertex, face, still, placed = stack.still_vertices, stack.still_faces, backdrop.still, backdrop.copied()
            nearest = wp.clone(backdrop.nearest)
        self._place(cameras, moved, placed, vertex)
        rows = self._rows(placed.seen, vertex, height)
        draw(placed.seen, stack.surfaces.triangles, face, rows, nearest, self.device)
        return self._shaded(cameras, placed, nearest, stack.casting, still)

    def _shaded(
        self, cameras: Sequence[Camera], placed: Placed, nearest: wp.array, casting: wp.array, still: Still
    ) -> Pictures:
        """Light what the z-buffers hold, in the shadow of some triangles."""
        count, height, width = nearest.shape
        shape = count, height * width
        colour = wp.empty((*shape, 3), dtype=wp.uint8, device=self.device)
        depth = wp.empty(shape, dtype=wp.float32, device=self.device)
        segmentation = wp.empty(shape, dtype=wp.uint8, device=self.device)
        inputs = [
            nearest, self.stack.surfaces, placed, self._eyes(cameras), self.light, self._shadow(placed, casting),
            self.curve, background(width, height, self.device), still,
        ]  # fmt: skip
        launch_in_bands(shade, inputs, [colour, depth, segmentation], count * height * width, self.device)
        return Pictures(
            colour.reshape((*nearest.shape, 3)), depth.reshape(nearest.shape), segmentation.reshape(nearest.shape)
        )

    def _place(self, cameras: Sequence[Camera], moved: wp.array, placed: Placed, since: int) -> None:
        """Find where the vertices from number `since` on lie in each picture."""
        stack = self.stack
        matrices = wp.array([projection(camera) for camera in cameras], dtype=wp.mat44d, device=self.device)
        inputs = [
            since, stack.still, moved, matrices, wp.mat44d(projection(self.lamp_camera)), stack.surfaces.triangles,
            stack.around, stack.faces,
        ]  # fmt: skip
        launch_in_bands(place, inputs, [placed], len(cameras) * (stack.vertices - since), self.device)

    def _rows(self, seen: wp.array, since: int, height: int) -> slice:
        """The rows that vertices from number `since` on can cover: on a card all, for to ask would take longer."""
        if self.device != "cpu":
            return slice(0, height)
        return slice(*rows_reached(seen.numpy()[:, since:].reshape(-1, 3), NEAR, height))

    def _shadow(self, placed: Placed, casting: wp.array) -> Shadow:
        """Draw the shadow map of each picture."""
        count, tiles = placed.lit.shape[0], SHADOW_PIXELS // int(TILE)
        shadow = Shadow()
        shadow.nearest = empty_buffer(count, SHADOW_PIXELS, SHADOW_PIXELS, self.device)
        shadow.bounds = wp.empty((count, tiles, tiles), dtype=wp.vec2f, device=self.device)
        draw(placed.lit, casting, 0, slice(0, SHADOW_PIXELS), shadow.nearest, self.device)
        launch_in_bands(bound, [shadow.nearest], [shadow.bounds], count * tiles * tiles, self.device)
        return shadow

    def _eyes(self, cameras: Sequence[Camera]) -> wp.array:
        return wp.array([camera.centre for camera in cameras], dtype=wp.vec3f, device=self.device)

    def _backdrop(self, camera: Camera, moved: wp.array) -> Backdrop:
        """What a camera sees of the layers that stand still; that of the last camera is kept."""
        if self.backdrop is not None and self.backdrop.camera is camera:
            return self.backdrop
        stack, size = self.stack, camera.height * camera.width
        placed, nearest = stack.unplaced(1), empty_buffer(1, camera.height, camera.width, self.device)
        self._place([camera], moved, placed, 0)
        there = stack.surfaces.triangles[: stack.still_faces]
        draw(placed.seen, there, 0, slice(0, camera.height), nearest, self.device)
        still = Still()
        still.faces = stack.still_faces
        still.colour = self._shaded([camera], placed, nearest, stack.casting[:0], self.nothing).colour.reshape(
            (size, 3)
        )
        still.lit = wp.zeros(size, dtype=wp.vec3f, device=self.device)
        inputs = [nearest, stack.surfaces, placed, self._eyes([camera]), self.light]
        launch_in_bands(remember, inputs, [still.lit], size, self.device)
        self.backdrop = Backdrop(camera, nearest, placed, still)
        return self.backdrop


def nothing_still(device: str) -> Still:
    """What is seen of no layers that stand still."""
    still = Still()
    still.colour = wp.empty((0, 3), dtype=wp.uint8, device=device)
    still.lit = wp.empty(0, dtype=wp.vec3f, device=device)
    return still


def projection(camera: Camera) -> np.ndarray:
    """(4, 4): takes a world point (x, 1) [m] to (u w, v w, w, 1)."""
    P = np.eye(4)
    P[:3] = camera.K @ camera.T_camera_world[:3]
    return P


def as_light(lamp: Lamp) -> Light:
    """The lamp as the kernel takes it."""
    camera = lamp.camera()
    axis = np.asarray(lamp.target) - lamp.position
    light = Light()
    light.position, light.axis = wp.vec3f(lamp.position), wp.vec3f(axis / np.linalg.norm(axis))
    angle = np.arctan(lamp.radius / np.linalg.norm(axis))
    light.outer, light.steepness = float(np.cos(angle)), float(1.0 / (np.cos(0.55 * angle) - np.cos(angle)))
    light.strength, light.ambient, light.P = lamp.strength, lamp.ambient, wp.mat44f(projection(camera))
    # As high as the filter is wide: then no slant to the lamp brings the surface itself under the filter.
    light.offset = float(1.05 * (SOFT + 0.5) * np.linalg.norm(axis) / camera.K[0, 0])
    return light


@lru_cache(maxsize=4)
def background(width: int, height: int, device: str) -> wp.array:
    """(H W, 3) uint8 on a device: a drape, brighter in the middle."""
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    fall = 1.0 - 0.45 * np.clip(np.hypot(x, y) / np.sqrt(2.0), 0.0, 1.0)
    return wp.array((255.0 * fall.reshape(-1, 1) * DRAPE).astype(np.uint8), dtype=wp.uint8, device=device)


@lru_cache(maxsize=1)
def tone_curve() -> np.ndarray:
    """(4096,) uint8: scene-linear light to display: filmic curve (Narkowicz 2016), then a gamma of 2."""
    x = np.linspace(0.0, float(BRIGHTEST), 4096)
    filmic = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)
    return (255.0 * np.sqrt(filmic) + 0.5).astype(np.uint8)
