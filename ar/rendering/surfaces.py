"""Layers combined to one surface on a device: topology, appearance and textures, separate from moving vertices."""

from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np
import warp as wp

from .layer import Layer, Solid
from .parallel import forward_kernel


@wp.struct
class Light:
    """Lamp for the kernels.

    The lamp has a position [m], a unit axis, the cosine of the lit cone's angle, the steepness of the soft edge, a
    strength and an ambient share. `P` maps a world point to (u w, v w, w) in the shadow map, which is sampled `offset`
    [m] above the surface.
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
class LayerShading:
    """Appearance of a layer: id, highlight, solid texture (first texel, size, transform, dark colour, relief [m])."""

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
    """All layers combined to one surface, which is the same in every image.

    `triangles` (F,) have a `shading_index` into `shadings`, one per layer. Vertices have scene-linear `colours` (V,)
    and undeformed positions `rest` (V,) [m]. `texels` (T,) are those of all solid textures: value and gradient.
    """

    triangles: wp.array(dtype=wp.vec3i)
    shading_index: wp.array(dtype=wp.uint8)
    shadings: wp.array(dtype=LayerShading)
    colours: wp.array(dtype=wp.vec3f)
    rest: wp.array(dtype=wp.vec3f)
    texels: wp.array(dtype=wp.vec4f)


@wp.struct
class PlacedSurface:
    """Vertices (B, V) in each image: homogeneous pixels of camera and lamp, world positions [m], and normals."""

    camera_points: wp.array2d(dtype=wp.vec3d)
    lamp_points: wp.array2d(dtype=wp.vec3d)
    vertices: wp.array2d(dtype=wp.vec3f)
    normals: wp.array2d(dtype=wp.vec3f)


@wp.struct
class Shadow:
    """Shadow maps, flat (B N N): depths [m], infinite where empty, and their minimum and maximum in each tile.

    `size` is N; there are N / TILE_SIDE tiles along each side.
    """

    size: wp.int32
    depth: wp.array(dtype=wp.float32)
    bounds: wp.array(dtype=wp.vec2f)


@wp.struct
class FaceCorners:
    """Data of a face that its pixels need: edges and normal in the image, and corner values to interpolate."""

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
class VisiblePoint:
    """Point visible at a pixel: position [m], unit direction to the viewer, unit normal, base colour."""

    position: wp.vec3f
    view: wp.vec3f
    normal: wp.vec3f
    base: wp.vec3f


def list_vertex_faces(triangles: np.ndarray, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the start (count + 1,) of each vertex's faces, and all these faces (3 F,), vertex by vertex, int32."""
    corners = triangles.reshape(-1)
    begins = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=vertex_count))])
    return begins.astype(np.int32), (np.argsort(corners, kind="stable") // 3).astype(np.int32)


@wp.func
def get_vertex_position(
    image: wp.int32, vertex: wp.int32, fixed_vertices: wp.array(dtype=wp.vec3d), moving: wp.array2d(dtype=wp.vec3d)
) -> wp.vec3d:
    """Return the position [m] of a vertex in an image; vertices of fixed layers come first."""
    if vertex < fixed_vertices.shape[0]:
        return fixed_vertices[vertex]
    return moving[image, vertex - fixed_vertices.shape[0]]


@wp.func
def project_point(P: wp.mat44d, x: wp.vec3d) -> wp.vec3d:
    """Project a point x to homogeneous pixel coordinates (u w, v w, w) by a matrix P."""
    q = P * wp.vec4d(x[0], x[1], x[2], wp.float64(1.0))
    return wp.vec3d(q[0], q[1], q[2])


@forward_kernel
def place_vertices(
    begin: wp.int32, end: wp.int32, chunk_size: wp.int32, first_vertex: wp.int32, fixed: wp.array(dtype=wp.vec3d),
    moving: wp.array2d(dtype=wp.vec3d), cameras: wp.array(dtype=wp.mat44d), lamp: wp.mat44d,
    triangles: wp.array(dtype=wp.vec3i), face_starts: wp.array(dtype=wp.int32), faces: wp.array(dtype=wp.int32),
    # output
    placed: PlacedSurface,
):  # fmt: skip
    """Place the vertices from `first_vertex` on in each image; normals are area-weighted means of face normals."""
    start = begin + wp.tid() * chunk_size
    each = placed.camera_points.shape[1] - first_vertex
    for index in range(start, wp.min(start + chunk_size, end)):
        picture = index / each
        vertex = first_vertex + index - picture * each
        x = get_vertex_position(picture, vertex, fixed, moving)
        placed.camera_points[picture, vertex] = project_point(cameras[picture], x)
        placed.lamp_points[picture, vertex] = project_point(lamp, x)
        placed.vertices[picture, vertex] = wp.vec3f(x)
        normal = wp.vec3d(wp.float64(0.0))
        for k in range(face_starts[vertex], face_starts[vertex + 1]):
            t = triangles[faces[k]]
            a = get_vertex_position(picture, t[0], fixed, moving)
            normal += wp.cross(
                get_vertex_position(picture, t[1], fixed, moving) - a,
                get_vertex_position(picture, t[2], fixed, moving) - a,
            )
        length = wp.length(normal)
        if length > wp.float64(0.0):
            normal /= length
        placed.normals[picture, vertex] = wp.vec3f(normal)


class LayerStack:
    """Layers combined to one surface on a device, fixed layers first.

    `still` (S,) [m] are the vertices that never move, and `still_faces` is the number of their triangles. `casting`
    (C,) are the triangles that cast shadows. `around` and `faces` are the arrays of `list_vertex_faces`.
    """

    def __init__(self, layers: Sequence[Layer], device: str) -> None:
        """Copy the layers to a device; ValueError if layers of different names have the same id."""
        ids = {(layer.name, layer.id) for layer in layers}
        if len({number for _, number in ids}) < len(ids):
            raise ValueError(f"layers have the names and ids {sorted(ids)}: give each name its own id.")
        layers = sorted(layers, key=lambda layer: not layer.still)
        starts = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
        parts = [layer.triangles + start for layer, start in zip(layers, starts[:-1], strict=True)]
        triangles = np.concatenate([np.zeros((0, 3), np.int32), *parts]).astype(np.int32)
        casting = [part for layer, part in zip(layers, parts, strict=True) if layer.casts_shadow]
        numbers = np.repeat(np.arange(len(layers)), [len(part) for part in parts])
        begins, faces = list_vertex_faces(triangles, int(starts[-1]))
        still = [layer for layer in layers if layer.still]
        here = partial(wp.array, device=device)
        vectors = partial(here, dtype=wp.vec3f)
        texels, looks = collect_textures(layers, device)

        self.device, self.vertices = device, int(starts[-1])
        self.still_vertices, self.still_faces = int(starts[len(still)]), sum(len(layer.triangles) for layer in still)
        self.still = here(np.concatenate([np.zeros((0, 3)), *(layer.vertices for layer in still)]), dtype=wp.vec3d)
        self.casting = here(np.concatenate([np.zeros((0, 3), np.int32), *casting]).astype(np.int32), dtype=wp.vec3i)
        self.around, self.faces = here(begins, dtype=wp.int32), here(faces, dtype=wp.int32)
        self.surfaces = Surfaces()
        self.surfaces.triangles = here(triangles, dtype=wp.vec3i)
        self.surfaces.shading_index = here(numbers.astype(np.uint8), dtype=wp.uint8)
        self.surfaces.shadings = here(looks, dtype=LayerShading)
        self.surfaces.colours = vectors(
            np.concatenate([np.zeros((0, 3)), *(np.square(layer.colour) for layer in layers)])
        )
        rest = [layer.vertices if layer.rest is None else layer.rest for layer in layers]
        self.surfaces.rest = vectors(np.concatenate([np.zeros((0, 3)), *rest]))
        self.surfaces.texels = texels

    def copy_vertices(self, vertices: np.ndarray | wp.array) -> wp.array:
        """Copy the moving vertices, (B, n, 3) [m] or a Warp array (B, n) of vec3d, to the device.

        Raises
        ------
        ValueError
            The array has another shape, or is not finite.
        """
        count = self.vertices - self.still_vertices
        if isinstance(vertices, wp.array):
            if vertices.dtype != wp.vec3d or vertices.ndim != 2 or vertices.shape[1] != count:
                raise ValueError(f"vertices on a device are (B, {count}) of vec3d, not {vertices.shape}.")
            return vertices
        if vertices.ndim != 3 or vertices.shape[1:] != (count, 3):
            raise ValueError(f"the layers that move have vertices (B, {count}, 3), not {vertices.shape}.")
        if not np.isfinite(vertices).all():
            raise ValueError("a vertex is not finite: every coordinate must be a finite number of metres.")
        return wp.array(vertices, dtype=wp.vec3d, device=self.device)

    def allocate_placed(self, count: int) -> PlacedSurface:
        """Allocate the arrays of the placed surface in `count` images."""
        placed, shape = PlacedSurface(), (count, self.vertices)
        placed.camera_points, placed.lamp_points = (
            wp.empty(shape, dtype=wp.vec3d, device=self.device) for _ in range(2)
        )
        placed.vertices, placed.normals = (wp.empty(shape, dtype=wp.vec3f, device=self.device) for _ in range(2))
        return placed


def collect_textures(layers: Sequence[Layer], device: str) -> tuple[wp.array, list[LayerShading]]:
    """Return the texels of all solid textures on a device, and the appearance of each layer."""
    solids = list(dict.fromkeys(layer.solid for layer in layers if layer.solid is not None))
    begins = np.cumsum([0, *(solid.values.size for solid in solids)])
    looks = []
    for layer in layers:
        look = LayerShading()
        look.id, look.gloss, look.shininess = layer.id, layer.gloss, layer.shininess
        look.textured = layer.solid is not None
        if layer.solid is not None:
            look.begin, look.size = int(begins[solids.index(layer.solid)]), wp.vec3i(*layer.solid.values.shape)
            look.T_index_world, look.relief = wp.mat44f(layer.solid.T_index_world), layer.solid.relief
            look.dark = wp.vec3f(layer.solid.dark)
        looks.append(look)
    return to_texels(tuple(solids), device), looks


@lru_cache(maxsize=4)
def to_texels(solids: tuple[Solid, ...], device: str) -> wp.array:
    """Copy the texels of solid textures to a device, one texture after the other."""
    each = [solid.texels.reshape(-1, 4) for solid in solids]
    # A single texture, such as a scan, is large: on the CPU it is used without a copy.
    texels = each[0] if len(each) == 1 else np.concatenate([np.zeros((0, 4), np.float32), *each])
    return wp.array(texels, dtype=wp.vec4f, device=device, copy=False)
