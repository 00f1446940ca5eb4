"""Surfaces and a camera in, a lit picture out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import cv2
import numpy as np
import warp as wp

from .camera import Camera, look_at
from .layer import Layer, Solid, vertex_normals
from .parallel import launch_in_bands
from .rasteriser import rasterise
from .shade import BRIGHTEST, SOFT, Light, Look, shade

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
    normal
        (H, W, 3) float32, unit, in the world frame, towards the camera; 0 where nothing is seen.
    segmentation
        (H, W) uint8: the id of the layer seen, 0 where nothing is seen.
    taken
        (H, W) uint8: above 0 where lines and words are drawn over it.
    """

    colour: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    segmentation: np.ndarray
    taken: np.ndarray


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
    """Draw layers as seen by a camera under a lamp.

    Raises
    ------
    ValueError
        Two layers with one id.
    """
    ids = [layer.id for layer in layers]
    if len(set(ids)) < len(ids):
        raise ValueError(f"layers have the ids {ids}: give each its own.")
    fragments = rasterise(camera, *joined(layers), device=device)
    shadow, bounds = shadow_map(lamp, [layer for layer in layers if layer.casts_shadow], device)
    light = as_light(lamp)
    seen = fragments.face.reshape(-1)
    on_device = partial(wp.array, device=device, copy=False)
    face = on_device(seen, dtype=wp.int32)
    weights = on_device(fragments.weights.reshape(-1, 3), dtype=wp.vec3f)
    lamp_arrays = [
        on_device(shadow, dtype=wp.float32),
        on_device(bounds, dtype=wp.vec2f),
        on_device(tone_curve(), dtype=wp.uint8),
    ]
    colour = wp.array(background(camera.width, camera.height), dtype=wp.uint8, device=device)
    normal = wp.zeros(face.shape, dtype=wp.vec3f, device=device)
    segmentation = wp.zeros(face.shape, dtype=wp.uint8, device=device)
    wp.load_module(shade.module, device=device)
    first = 0
    for layer in layers:
        stop = first + len(layer.triangles)
        pixels = on_device(np.flatnonzero((first <= seen) & (seen < stop)), dtype=wp.int32)
        inputs = [
            pixels,
            face,
            weights,
            first,
            *as_surface(layer, device),
            wp.vec3f(camera.centre),
            light,
            *lamp_arrays,
        ]
        launch_in_bands(shade, inputs, [colour, normal, segmentation], len(pixels), device)
        first = stop
    height, width = fragments.face.shape
    return Picture(
        colour.numpy().reshape(height, width, 3),
        fragments.depth,
        normal.numpy().reshape(height, width, 3),
        segmentation.numpy().reshape(height, width),
        np.zeros((height, width), np.uint8),
    )


def joined(layers: Sequence[Layer]) -> tuple[np.ndarray, np.ndarray]:
    """All layers as one surface: vertices (V, 3), triangles (F, 3), in the order of the layers."""
    starts = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
    vertices = np.concatenate([np.zeros((0, 3)), *(layer.vertices for layer in layers)])
    triangles = [layer.triangles + start for layer, start in zip(layers, starts[:-1], strict=True)]
    return vertices, np.concatenate([np.zeros((0, 3), np.int32), *triangles])


def shadow_map(lamp: Lamp, casters: Sequence[Layer], device: str) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] from the lamp (N, N), infinite where nothing is, and its least and greatest under the filter."""
    depth = rasterise(lamp.camera(), *joined(casters), device=device).depth
    depth = np.where(depth > 0.0, depth, np.float32(np.inf))
    window = np.ones((2 * SOFT + 1, 2 * SOFT + 1), np.uint8)
    return depth, np.stack([cv2.erode(depth, window), cv2.dilate(depth, window)], axis=-1)


def as_light(lamp: Lamp) -> Light:
    """The lamp as the kernel takes it."""
    camera = lamp.camera()
    axis = np.asarray(lamp.target) - lamp.position
    projection = np.eye(4)
    projection[:3] = camera.K @ camera.T_camera_world[:3]
    light = Light()
    light.position, light.axis = wp.vec3f(lamp.position), wp.vec3f(axis / np.linalg.norm(axis))
    angle = np.arctan(lamp.radius / np.linalg.norm(axis))
    light.outer, light.steepness = float(np.cos(angle)), float(1.0 / (np.cos(0.55 * angle) - np.cos(angle)))
    light.strength, light.ambient, light.P = lamp.strength, lamp.ambient, wp.mat44f(projection)
    # As high as the filter is wide: then no slant to the lamp brings the surface itself under the filter.
    light.offset = float(1.05 * (SOFT + 0.5) * np.linalg.norm(axis) / camera.K[0, 0])
    return light


@lru_cache(maxsize=16)
def as_surface(layer: Layer, device: str) -> tuple:
    """The layer as the kernel takes it, from `triangles` to `look`; a layer that stands still is made once."""
    normals = vertex_normals(layer.vertices, layer.triangles)
    look = Look()
    look.id, look.gloss, look.shininess = layer.id, layer.gloss, layer.shininess
    look.textured = layer.solid is not None
    if layer.solid is not None:
        look.T_index_world, look.relief = wp.mat44f(layer.solid.T_index_world), layer.solid.relief
        look.dark = wp.vec3f(layer.solid.dark)
    vectors = partial(wp.array, dtype=wp.vec3f, device=device)
    return (
        wp.array(layer.triangles, dtype=wp.vec3i, device=device),
        vectors(layer.vertices),
        vectors(normals),
        vectors(np.asarray(layer.colour) ** 2),
        vectors(layer.vertices if layer.rest is None else layer.rest),
        as_texels(layer.solid, device),
        look,
    )


@lru_cache(maxsize=4)
def as_texels(solid: Solid | None, device: str) -> wp.array:
    """A solid texture as the kernel takes it."""
    texels = np.zeros((1, 1, 1, 4), np.float32) if solid is None else solid.texels
    return wp.array(texels, dtype=wp.vec4f, device=device, copy=False)


@lru_cache(maxsize=4)
def background(width: int, height: int) -> np.ndarray:
    """(H W, 3) uint8: a drape, brighter in the middle."""
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    fall = 1.0 - 0.45 * np.clip(np.hypot(x, y) / np.sqrt(2.0), 0.0, 1.0)
    return (255.0 * fall.reshape(-1, 1) * DRAPE).astype(np.uint8)


@lru_cache(maxsize=1)
def tone_curve() -> np.ndarray:
    """(4096,) uint8: scene-linear light to display: filmic curve (Narkowicz 2016), then a gamma of 2."""
    x = np.linspace(0.0, float(BRIGHTEST), 4096)
    filmic = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)
    return (255.0 * np.sqrt(filmic) + 0.5).astype(np.uint8)
