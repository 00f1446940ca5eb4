"""What shading is given: the lamp, looks, surfaces, where they lie, shadow maps; as Warp kernels see it."""

from __future__ import annotations

import warp as wp


@wp.struct
class Light:
    """The lamp as the kernel sees it.

    It has a position [m], a unit axis, the cosine of the lit cone's angle, how fast its rim fades in, a strength and an
    ambient share. `P` takes a world point to (u w, v w, w) in the shadow map, which is read `offset` [m] above the
    surface.
    """

    position: wp.vec3f
    axis: wp.vec3f
    outer: wp.float32
    steepness: wp.float32
    strength: wp.float32
    ambient: wp.float32
    P: wp.mat44f
    offset: wp.float32


@wp.struct
class Look:
    """A layer's look: its number, highlight, solid texture (first texel, size, transform, dark end, relief [m])."""

    id: wp.uint8
    gloss: wp.float32
    shininess: wp.float32
    textured: wp.bool
    begin: wp.int32
    size: wp.vec3i
    T_index_world: wp.mat44f
    dark: wp.vec3f
    relief: wp.float32


@wp.struct
class Surfaces:
    """All layers as one surface, the same in every picture.

    `triangles` (F,) of vertices, `look_of` each, `looks` of the layers; `colours` (V,) scene-linear, `rest` (V,) [m];
    `texels` (T,) of all solid textures, one after the other: value and gradient.
    """

    triangles: wp.array(dtype=wp.vec3i)
    look_of: wp.array(dtype=wp.uint8)
    looks: wp.array(dtype=Look)
    colours: wp.array(dtype=wp.vec3f)
    rest: wp.array(dtype=wp.vec3f)
    texels: wp.array(dtype=wp.vec4f)


@wp.struct
class Placed:
    """The surface in each picture (B, V): homogeneous as seen by the camera, and by the lamp, in the world, normals."""

    seen: wp.array2d(dtype=wp.vec3d)
    lit: wp.array2d(dtype=wp.vec3d)
    vertices: wp.array2d(dtype=wp.vec3f)
    normals: wp.array2d(dtype=wp.vec3f)


@wp.struct
class Shadow:
    """Shadow maps, flat (B N N): depth [m], infinite where nothing is; and the least and greatest of each tile.

    `size` is N, and there are N / TILE tiles along each side.
    """

    size: wp.int32
    depth: wp.array(dtype=wp.float32)
    bounds: wp.array(dtype=wp.vec2f)


@wp.struct
class Corners:
    """A face as its pixels need it: for the weights edges and normal in the picture, and what is blended."""

    edge_b: wp.vec3d
    edge_c: wp.vec3d
    normal: wp.vec3d
    a: wp.vec3f
    b: wp.vec3f
    c: wp.vec3f
    flat: wp.vec3f
    normal_a: wp.vec3f
    normal_b: wp.vec3f
    normal_c: wp.vec3f
    colour_a: wp.vec3f
    colour_b: wp.vec3f
    colour_c: wp.vec3f
    rest_a: wp.vec3f
    rest_b: wp.vec3f
    rest_c: wp.vec3f


@wp.struct
class Point:
    """What a pixel sees: the place [m], the unit directions to the viewer and of the normal, the base colour."""

    place: wp.vec3f
    view: wp.vec3f
    normal: wp.vec3f
    base: wp.vec3f
