"""Depth of field and shot noise of a camera, added to the colours of an image; depth and ids are unchanged."""

from dataclasses import replace

import cv2
import numpy as np
import warp as wp

from ..optics.camera import Camera
from .renderer import Picture

MIN_FOCUS = 1e-3  # Smallest distance in focus [m].
BLURS = (0.0, 0.7, 1.4, 2.8, 5.6, 11.2)  # Standard deviations of the blurred images that are blended [pixel].


def add_camera_effects(
    image: Picture, camera: Camera, focus: np.ndarray, aperture: float, noise: float, frame_number: int
) -> Picture:
    """Return an image with the depth of field of a lens and the noise of a sensor; `frame_number` seeds the noise.

    The point `focus` (3,) [m] is sharp; `aperture` is the lens diameter [m]. `noise` is the standard deviation of shot
    noise, as a share of white; displayed values are about the square root of light, so it is equal for dark and bright.
    """
    if aperture == 0.0 and noise == 0.0:
        return image
    colour = image.colour
    if aperture > 0.0:
        sharp = float(camera.to_camera_frame(focus)[2])
        colour = blur_by_depth(colour, image.depth, camera.K[0, 0] * aperture, sharp)
    if noise > 0.0:
        random = np.random.default_rng(frame_number)
        noisy = colour + np.float32(255.0 * noise) * random.standard_normal(colour.shape, np.float32)
        colour = np.clip(np.rint(noisy), 0.0, 255.0).astype(np.uint8)
    drawn = image.drawn
    return Picture(replace(drawn, colour=wp.array(colour[None], dtype=wp.vec3ub, device=drawn.colour.device)))


def blur_by_depth(image: np.ndarray, depth: np.ndarray, strength: float, focus: float) -> np.ndarray:
    """Blur colours (H, W, 3) uint8 by their depth (H, W) [m], where 0 means infinitely far; return the image.

    The circle of confusion has the diameter strength |1 / depth - 1 / focus| [pixel] (Potmesil, Chakravarty 1981), with
    `strength` = focal length [pixel] x aperture [m]. The Gaussian's standard deviation is half the circle's radius.
    """
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
    spread = cv2.GaussianBlur(
        np.minimum(0.25 * strength * np.abs(inverse - 1.0 / max(focus, MIN_FOCUS)), BLURS[-1]), (0, 0), 2.0
    )
    level = np.interp(spread, BLURS, np.arange(len(BLURS))).astype(np.float32)
    out = np.zeros(image.shape, np.float32)
    for k, blur in enumerate(BLURS):
        share = np.maximum(1.0 - np.abs(level - k), 0.0)[..., None]
        if share.any():
            out += share * (cv2.GaussianBlur(image, (0, 0), blur) if blur > 0.0 else image)
    return np.rint(out).astype(np.uint8)
