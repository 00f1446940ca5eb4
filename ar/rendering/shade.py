"""Deferred shading in Warp: colour of the visible points under the lamp, for all images in one launch."""

import warp as wp

from .lens_rasteriser import undistort_pixel
from .parallel import forward_kernel
from .rasteriser import EMPTY_PIXEL, unpack_depth, unpack_face
from .surfaces import FaceCorners, LayerShading, Light, PlacedSurface, Shadow, Surfaces, VisiblePoint
from .triangle import compute_weights_from_edges

DEPTH_BIAS = wp.constant(0.0002)  # Minimum depth of an occluder in front of a point that it shades [m].
HALF_SOFT_WIDTH = wp.constant(3)  # Half the width of the shadow's soft edge [shadow-map pixel].
FILTER_WIDTH = wp.constant(7)  # Width of the shadow filter [shadow-map pixel]: 2 HALF_SOFT_WIDTH + 1.
Taps = wp.types.vector(length=7, dtype=wp.float32)
# Side of the tiles of the shadow map's depth bounds [shadow-map pixel]: the filter overlaps at most four.
TILE_SIDE = wp.constant(8)
WHITE_LEVEL = wp.constant(4.0)  # Scene-linear light displayed as white.


@wp.func
def normalise(v: wp.vec3f) -> wp.vec3f:
    """Compute v / |v| with one division instead of Warp's three; this is half of the work per pixel."""
    return v * (1.0 / wp.sqrt(wp.dot(v, v) + 1.0e-30))


@wp.func
def interpolate(w: wp.vec3f, a: wp.vec3f, b: wp.vec3f, c: wp.vec3f) -> wp.vec3f:
    """Interpolate the values a, b, c at a triangle's corners with barycentric weights w."""
    return w[0] * a + w[1] * b + w[2] * c


@wp.func
def sample_texture(texels: wp.array(dtype=wp.vec4f), first: wp.int32, size: wp.vec3i, index: wp.vec3f) -> wp.vec4f:
    """Sample (value, gradient) of a solid texture trilinearly at a voxel index, which is clamped to the border."""
    x = wp.clamp(index[0], 0.0, wp.float32(size[0] - 1))
    y = wp.clamp(index[1], 0.0, wp.float32(size[1] - 1))
    z = wp.clamp(index[2], 0.0, wp.float32(size[2] - 1))
    i = wp.min(wp.int32(x), size[0] - 2)
    j = wp.min(wp.int32(y), size[1] - 2)
    k = wp.min(wp.int32(z), size[2] - 2)
    a = x - wp.float32(i)
    b = y - wp.float32(j)
    c = z - wp.float32(k)
    low = first + (i * size[1] + j) * size[2] + k
    high = low + size[1] * size[2]
    near = wp.lerp(
        wp.lerp(texels[low], texels[low + 1], c), wp.lerp(texels[low + size[2]], texels[low + size[2] + 1], c), b
    )
    far = wp.lerp(
        wp.lerp(texels[high], texels[high + 1], c), wp.lerp(texels[high + size[2]], texels[high + size[2] + 1], c), b
    )
    return wp.lerp(near, far, a)


@wp.func
def gather_face_corners(image: wp.int32, face: wp.int32, surfaces: Surfaces, placed: PlacedSurface) -> FaceCorners:
    """Gather the data of a face, which neighbouring pixels share."""
    t = surfaces.triangles[face]
    qa = placed.camera_points[image, t[0]]
    qb = placed.camera_points[image, t[1]]
    qc = placed.camera_points[image, t[2]]
    out = FaceCorners()
    out.edge_b = wp.cross(qc, qa - qc)
    out.edge_c = wp.cross(qa, qb - qa)
    out.normal = wp.cross(qb - qa, qc - qa)
    out.a = placed.vertices[image, t[0]]
    out.b = placed.vertices[image, t[1]]
    out.c = placed.vertices[image, t[2]]
    out.flat = wp.cross(out.b - out.a, out.c - out.a)
    out.normal_a = placed.normals[image, t[0]]
    out.normal_b = placed.normals[image, t[1]]
    out.normal_c = placed.normals[image, t[2]]
    out.colour_a = surfaces.colours[t[0]]
    out.colour_b = surfaces.colours[t[1]]
    out.colour_c = surfaces.colours[t[2]]
    out.rest_a = surfaces.rest[t[0]]
    out.rest_b = surfaces.rest[t[1]]
    out.rest_c = surfaces.rest[t[2]]
    return out


@wp.func
def compute_visible_point(
    p: wp.vec3d, corners: FaceCorners, shading: LayerShading, texels: wp.array(dtype=wp.vec4f), eye: wp.vec3f
) -> VisiblePoint:
    """Compute the point of a face that is visible at a pixel p = (u, v, 1), with its normal and base colour."""
    w = compute_weights_from_edges(p, corners.edge_b, corners.edge_c, corners.normal)
    out = VisiblePoint()
    out.position = interpolate(w, corners.a, corners.b, corners.c)
    out.view = normalise(eye - out.position)
    n = normalise(interpolate(w, corners.normal_a, corners.normal_b, corners.normal_c))
    # Oriented to the viewer by the visible flat side: near a silhouette the smooth normal may point away.
    if wp.dot(corners.flat, n) * wp.dot(corners.flat, out.view) < 0.0:
        n = -n
    out.base = interpolate(w, corners.colour_a, corners.colour_b, corners.colour_c)
    if shading.textured:
        x = interpolate(w, corners.rest_a, corners.rest_b, corners.rest_c)
        s = sample_texture(texels, shading.begin, shading.size, wp.transform_point(shading.T_index_world, x))
        out.base = wp.cw_mul(out.base, shading.dark + (wp.vec3f(1.0) - shading.dark) * s[0])
        slope = wp.vec3f(s[1], s[2], s[3])
        n = normalise(n - shading.relief * (slope - wp.dot(slope, n) * n))
    out.normal = n
    return out


@wp.func
def compute_shadow_position(position: wp.vec3f, normal: wp.vec3f, light: Light) -> wp.vec3f:
    """Compute column, row and depth [m] of a point in the shadow map; the depth is <= 0 behind the lamp."""
    above = position + light.offset * normal
    q = light.P * wp.vec4f(above[0], above[1], above[2], 1.0)
    if q[2] <= 0.0:
        return wp.vec3f(0.0)
    scale = 1.0 / q[2]
    return wp.vec3f(q[0] * scale, q[1] * scale, q[2])


@wp.func
def compute_lit_share(image: wp.int32, position: wp.vec3f, shadow: Shadow) -> wp.float32:
    """Compute the share of the lamp's light at a point by percentage-closer filtering (Reeves et al. 1987).

    For most points, the depth bounds of the tiles under the filter give the result without filtering.
    """
    column = wp.int32(position[0] + 0.5)
    row = wp.int32(position[1] + 0.5)
    size = shadow.size
    if (
        position[2] <= 0.0
        or row < HALF_SOFT_WIDTH
        or column < HALF_SOFT_WIDTH
        or row >= size - HALF_SOFT_WIDTH
        or column >= size - HALF_SOFT_WIDTH
    ):
        return 1.0
    z = position[2] - DEPTH_BIAS
    tiles = size / TILE_SIDE
    top = (image * tiles + (row - HALF_SOFT_WIDTH) / TILE_SIDE) * tiles
    low = (image * tiles + (row + HALF_SOFT_WIDTH) / TILE_SIDE) * tiles
    left = (column - HALF_SOFT_WIDTH) / TILE_SIDE
    right = (column + HALF_SOFT_WIDTH) / TILE_SIDE
    first = shadow.bounds[top + left]
    second = shadow.bounds[top + right]
    third = shadow.bounds[low + left]
    fourth = shadow.bounds[low + right]
    if z <= wp.min(wp.min(first[0], second[0]), wp.min(third[0], fourth[0])):
        return 1.0
    if z > wp.max(wp.max(first[1], second[1]), wp.max(third[1], fourth[1])):
        return 0.0
    # A box 2 HALF_SOFT_WIDTH wide about (u, v). Taps at its border are weighted by their part inside the box.
    # Without weights, steps are visible.
    reach = wp.float32(HALF_SOFT_WIDTH) + 0.5
    across = Taps()
    for j in range(FILTER_WIDTH):
        across[j] = wp.min(reach - wp.abs(wp.float32(column - HALF_SOFT_WIDTH + j) - position[0]), 1.0)
    hidden = wp.float32(0.0)
    for i in range(FILTER_WIDTH):
        begin = (image * size + row - HALF_SOFT_WIDTH + i) * size + column - HALF_SOFT_WIDTH
        along = wp.float32(0.0)
        for j in range(FILTER_WIDTH):
            along += wp.where(z > shadow.depth[begin + j], across[j], 0.0)
        hidden += along * wp.min(reach - wp.abs(wp.float32(row - HALF_SOFT_WIDTH + i) - position[1]), 1.0)
    return 1.0 - hidden / wp.float32(4 * HALF_SOFT_WIDTH * HALF_SOFT_WIDTH)


@wp.func
def apply_tone_curve(light: wp.float32, curve: wp.array(dtype=wp.uint8)) -> wp.uint8:
    """Map scene-linear light to an 8-bit value by the table `curve`, which spans 0 .. WHITE_LEVEL."""
    return curve[wp.int32(wp.min(light * (1.0 / WHITE_LEVEL), 1.0) * wp.float32(curve.shape[0] - 1))]


@wp.func
def compute_light(point: VisiblePoint, shading: LayerShading, light: Light, lit_share: wp.float32) -> wp.vec3f:
    """Compute the scene-linear light from a point that receives `lit_share` of the lamp's light.

    The light is base (ambient + wrapped Lambert) + Schlick's Fresnel x Gaussian lobe, in a lit circle with a soft edge.
    """
    ray = normalise(light.position - point.position)
    rim = wp.clamp((-wp.dot(ray, light.axis) - light.outer) * light.steepness, 0.0, 1.0)
    arriving = lit_share * light.strength * rim * rim * (3.0 - 2.0 * rim)
    wrapped = wp.max(0.0, (wp.dot(point.normal, ray) + 0.2) * 0.83333)
    # The lamp is near the viewer: surfaces facing away from both are in the wound's shade.
    ambient = light.ambient * (0.35 + 0.65 * wp.max(0.0, wp.dot(point.normal, point.view)))
    out = point.base * (ambient + arriving * wrapped)
    glow = arriving * shading.gloss
    if glow > 0.0:
        middle = normalise(ray + point.view)
        grazing = 1.0 - wp.max(0.0, wp.dot(point.view, middle))
        fresnel = 0.04 + 0.96 * grazing * grazing * grazing * grazing * grazing
        lobe = wp.exp(shading.shininess * (wp.dot(point.normal, middle) - 1.0)) * (shading.shininess + 8.0) * 0.12
        out += wp.vec3f(glow * fresnel * lobe)
    return out


@forward_kernel
def compute_shadow_depths(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, z_buffer: wp.array3d(dtype=wp.uint64),
    # output
    shadow: Shadow,
):  # fmt: skip
    """Compute the depths of shadow maps, and their minimum and maximum in each of a chunk of tiles."""
    start = begin + wp.tid() * chunk_size
    tiles = shadow.size / TILE_SIDE
    for index in range(start, wp.min(start + chunk_size, end)):
        picture = index / (tiles * tiles)
        row = (index / tiles) % tiles
        column = index % tiles
        least = wp.float32(wp.inf)
        greatest = wp.float32(0.0)
        for i in range(row * TILE_SIDE, (row + 1) * TILE_SIDE):
            for j in range(column * TILE_SIDE, (column + 1) * TILE_SIDE):
                key = z_buffer[picture, i, j]
                depth = wp.float32(wp.inf)
                if key != EMPTY_PIXEL:
                    depth = unpack_depth(key)
                shadow.depth[(picture * shadow.size + i) * shadow.size + j] = depth
                least = wp.min(least, depth)
                greatest = wp.max(greatest, depth)
        shadow.bounds[index] = wp.vec2f(least, greatest)


@forward_kernel
def compute_shadow_positions(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, width: wp.int32, z_buffer: wp.array(dtype=wp.uint64),
    surfaces: Surfaces, placed: PlacedSurface, eyes: wp.array(dtype=wp.vec3f), light: Light,
    pixels: wp.array3d(dtype=wp.vec2d),
    # outputs
    positions: wp.array(dtype=wp.vec3f),
):  # fmt: skip
    """Compute the position in the shadow map of each pixel of one image, flat (H W)."""
    start = begin + wp.tid() * chunk_size
    for index in range(start, wp.min(start + chunk_size, end)):
        row = index / width
        column = index - row * width
        key = z_buffer[index]
        if key != EMPTY_PIXEL:
            winner = unpack_face(key)
            look = surfaces.shadings[wp.int32(surfaces.shading_index[winner])]
            corners = gather_face_corners(0, winner, surfaces, placed)
            p = undistort_pixel(0, column, row, pixels)
            point = compute_visible_point(p, corners, look, surfaces.texels, eyes[0])
            positions[index] = compute_shadow_position(point.position, point.normal, light)


@forward_kernel
def shade_pixels(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, width: wp.int32, size: wp.int32,
    z_buffer: wp.array(dtype=wp.uint64), surfaces: Surfaces, placed: PlacedSurface, eyes: wp.array(dtype=wp.vec3f),
    light: Light, shadow: Shadow, curve: wp.array(dtype=wp.uint8), static_faces: wp.int32,
    shadow_positions: wp.array(dtype=wp.vec3f), pixels: wp.array3d(dtype=wp.vec2d),
    # outputs
    colour: wp.array(dtype=wp.vec3ub), depth: wp.array(dtype=wp.float32), segmentation: wp.array(dtype=wp.uint8),
):  # fmt: skip
    """Shade a chunk of the pixels begin .. end - 1 of all images, flat (B H W), with `size` = H W pixels each.

    The outputs already contain the background and the first `static_faces` faces without shadows. Their pixels change
    only if a shadow falls on them; `shadow_positions` (H W) are the positions of these pixels in the shadow map.
    """
    start = begin + wp.tid() * chunk_size
    picture = start / size
    pixel = start - picture * size - 1
    last = wp.int32(-1)
    bent = pixels.shape[0] > 0
    corners = FaceCorners()
    look = LayerShading()
    for index in range(start, wp.min(start + chunk_size, end)):
        pixel += 1
        if pixel == size:
            pixel = 0
            picture += 1
        key = z_buffer[index]
        winner = unpack_face(key)
        share = wp.float32(1.0)
        if key != EMPTY_PIXEL and winner < static_faces:
            share = compute_lit_share(picture, shadow_positions[pixel], shadow)
        if key != EMPTY_PIXEL and (winner >= static_faces or share < 1.0):
            row = pixel / width
            column = pixel - row * width
            if winner != last or column == 0:
                last = winner
                corners = gather_face_corners(picture, winner, surfaces, placed)
                look = surfaces.shadings[wp.int32(surfaces.shading_index[winner])]
            p = wp.vec3d(wp.float64(column), wp.float64(row), wp.float64(1.0))
            if bent:  # this test saves a seventh of the time for images without a lens
                p = undistort_pixel(picture, column, row, pixels)
            point = compute_visible_point(p, corners, look, surfaces.texels, eyes[picture])
            if winner >= static_faces:
                depth[index] = unpack_depth(key)
                segmentation[index] = look.id
                share = compute_lit_share(picture, compute_shadow_position(point.position, point.normal, light), shadow)
            out = compute_light(point, look, light, share)
            colour[index] = wp.vec3ub(
                apply_tone_curve(out[0], curve), apply_tone_curve(out[1], curve), apply_tone_curve(out[2], curve)
            )
