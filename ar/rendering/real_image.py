"""Images that are not rendered (camera images, enlarged images), and the round field of view of a microscope."""

from collections.abc import Sequence

import cv2
import numpy as np
import warp as wp

from ..optics.camera import Camera
from .layer import Layer
from .parallel import forward_kernel, launch_in_bands, load_modules
from .rasteriser import rasterise
from .renderer import Picture, Pictures

SOFT_EDGE_SHARE = wp.constant(0.12)  # Width of the field's soft edge as a share of its radius.


def add_vignette(image: Picture, radius_ratio: float) -> Picture:
    """Darken an image outside the radius `radius_ratio` x half its longer side; depths and ids are unchanged.

    The colours change in place, on the image's device.

    Raises
    ------
    ValueError
        `radius_ratio` is not a finite number above 0.
    """
    if not 0.0 < radius_ratio < float("inf"):
        raise ValueError(f"a round field has a radius above 0, not {radius_ratio}.")
    colour = image.drawn.colour
    device = str(colour.device)
    load_modules(device, __name__)
    count, height, width = colour.shape
    radius = 0.5 * radius_ratio * max(height, width)
    launch_in_bands(darken_outside_radius, [wp.float32(radius)], [colour], count * height * width, device)
    return Picture(image.drawn)


@forward_kernel
def darken_outside_radius(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, radius: wp.float32,
    # output
    image: wp.array3d(dtype=wp.vec3ub),
):  # fmt: skip
    """Darken pixels begin .. end - 1 beyond `radius` [pixel] round each image's centre, a chunk per thread."""
    start = begin + wp.tid() * chunk_size
    height = image.shape[1]
    width = image.shape[2]
    for index in range(start, wp.min(start + chunk_size, end)):
        picture = index / (height * width)
        row = (index / width) % height
        column = index % width
        x = wp.float32(column) - 0.5 * wp.float32(width - 1)
        y = wp.float32(row) - 0.5 * wp.float32(height - 1)
        inside = (1.0 - wp.sqrt(x * x + y * y) / radius) / SOFT_EDGE_SHARE
        if inside < 1.0:
            share = wp.max(inside, 0.0)
            share = share * share * (3.0 - 2.0 * share)
            was = image[picture, row, column]
            image[picture, row, column] = wp.vec3ub(
                wp.uint8(share * wp.float32(was[0])),
                wp.uint8(share * wp.float32(was[1])),
                wp.uint8(share * wp.float32(was[2])),
            )


def build_real_image(
    image: np.ndarray, camera: Camera, layers: Sequence[Layer], box: tuple[slice, slice], device: str = "cpu"
) -> Picture:
    """Combine a camera image (H, W, 3) uint8 with depth and segmentation computed from layers; return the image.

    Parameters
    ----------
    layers
        Known surfaces of the scene, of which positions and ids are used; at each pixel the nearest layer counts.
    box
        Rows and columns in which layers are rasterised; outside, depth and ids are 0.

    Raises
    ------
    ValueError
        The image does not have the camera's size.
    """
    if image.shape != (camera.height, camera.width, 3):
        raise ValueError(f"the image is {image.shape}, the camera {(camera.height, camera.width, 3)}.")
    depth, segmentation = np.zeros(image.shape[:2], np.float32), np.zeros(image.shape[:2], np.uint8)
    if layers:
        starts = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
        triangles = [layer.triangles + start for layer, start in zip(layers, starts, strict=False)]
        ids = np.repeat([layer.id for layer in layers], [len(each) for each in triangles]).astype(np.uint8)
        vertices = np.concatenate([layer.vertices for layer in layers])
        found = rasterise(camera.crop_to(*box), vertices, np.concatenate(triangles), device=device)
        depth[box] = found.depth
        segmentation[box] = np.where(found.mask, ids[found.face], 0)
    return _upload_image(image.copy(), depth, segmentation, device)


def scale_image(image: Picture, width: int, height: int) -> Picture:
    """Return the image at another size: colours are interpolated, depths and ids are taken from the nearest pixel."""
    size, device = (width, height), str(image.drawn.colour.device)
    depth, segmentation = (
        cv2.resize(values, size, interpolation=cv2.INTER_NEAREST) for values in (image.depth, image.segmentation)
    )
    return _upload_image(cv2.resize(image.colour, size), depth, segmentation, device)


def _upload_image(colour: np.ndarray, depth: np.ndarray, segmentation: np.ndarray, device: str) -> Picture:
    """Copy colour (H, W, 3) uint8, depth (H, W) float32 and segmentation (H, W) uint8 to a device; return the image."""
    arrays = (
        wp.array(np.ascontiguousarray(values)[None], dtype=dtype, device=device, copy=False)
        for values, dtype in ((colour, wp.vec3ub), (depth, wp.float32), (segmentation, wp.uint8))
    )
    return Picture(Pictures(*arrays))
