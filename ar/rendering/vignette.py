"""The round field of an operating microscope: dark beyond it, with a soft rim."""

from __future__ import annotations

import warp as wp

from .parallel import forward_kernel, launch_in_bands, load
from .renderer import Picture

# Over so large a share of the field's radius, inwards from its edge, its light falls to none.
SOFT = wp.constant(0.12)


def vignetted(picture: Picture, field: float) -> Picture:
    """The picture in a round field whose radius is `field` halves of the picture's longer side; depths and ids stay.

    Its colours change in place, on their device.

    Raises
    ------
    ValueError
        A field that is no number above 0.
    """
    if not 0.0 < field < float("inf"):
        raise ValueError(f"a round field has a radius above 0, not {field}.")
    colour = picture.drawn.colour
    device = str(colour.device)
    load(device, __name__)
    count, height, width = colour.shape
    radius = 0.5 * field * max(height, width)
    launch_in_bands(darken, [wp.float32(radius)], [colour], count * height * width, device)
    return Picture(picture.drawn)


@forward_kernel
def darken(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    radius: wp.float32,
    # output
    colour: wp.array3d(dtype=wp.vec3ub),
):
    """Darken a run of the pixels begin .. end - 1 beyond a radius [pixel] about the middle of each picture."""
    start = begin + wp.tid() * run
    height = colour.shape[1]
    width = colour.shape[2]
    for index in range(start, wp.min(start + run, end)):
        picture = index / (height * width)
        row = (index / width) % height
        column = index % width
        x = wp.float32(column) - 0.5 * wp.float32(width - 1)
        y = wp.float32(row) - 0.5 * wp.float32(height - 1)
        inside = (1.0 - wp.sqrt(x * x + y * y) / radius) / SOFT
        if inside < 1.0:
            share = wp.max(inside, 0.0)
            share = share * share * (3.0 - 2.0 * share)
            was = colour[picture, row, column]
            colour[picture, row, column] = wp.vec3ub(
                wp.uint8(share * wp.float32(was[0])),
                wp.uint8(share * wp.float32(was[1])),
                wp.uint8(share * wp.float32(was[2])),
            )
