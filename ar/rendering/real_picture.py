"""A real picture in place of a drawn one: its colours, and what is known of depth and of what lies in front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from ..optics.camera import Camera
from .layer import Layer
from .rasteriser import rasterise
from .renderer import Picture, Pictures


def real_picture(
    colour: np.ndarray, camera: Camera, layers: Sequence[Layer], box: tuple[slice, slice], device: str = "cpu"
) -> Picture:
    """A picture (H, W, 3) uint8 that a camera took, with depth and segmentation of layers where they should be seen.

    Parameters
    ----------
    layers
        What is known of the scene; of each the place and the id are used. The nearest one is seen.
    box
        Rows and columns in which layers are looked for; elsewhere nothing is known.

    Raises
    ------
    ValueError
        A picture of another size than the camera's.
    """
    if colour.shape != (camera.height, camera.width, 3):
        raise ValueError(f"the picture is {colour.shape}, the camera {(camera.height, camera.width, 3)}.")
    depth = np.zeros((1, *colour.shape[:2]), np.float32)
    segmentation = np.zeros(depth.shape, np.uint8)
    if layers:
        starts = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
        triangles = [layer.triangles + start for layer, start in zip(layers, starts, strict=False)]
        ids = np.repeat([layer.id for layer in layers], [len(each) for each in triangles]).astype(np.uint8)
        vertices = np.concatenate([layer.vertices for layer in layers])
        found = rasterise(camera.cropped(*box), vertices, np.concatenate(triangles), device=device)
        depth[0][box] = found.depth
        segmentation[0][box] = np.where(found.mask, ids[found.face], 0)
    drawn = Pictures(
        wp.array(np.ascontiguousarray(colour)[None], dtype=wp.vec3ub, device=device),
        wp.array(depth, dtype=wp.float32, device=device),
        wp.array(segmentation, dtype=wp.uint8, device=device),
    )
    return Picture(drawn)
