"""Surfaces to render, with their appearance."""

from dataclasses import dataclass

import numpy as np

from .rasteriser import check_mesh


@dataclass(frozen=True, eq=False)
class Solid:
    """Solid texture: a grey volume that the surface cuts, sampled per pixel at the material points `Layer.rest`.

    Parameters
    ----------
    values
        Values (X, Y, Z) in [0, 1]; the layer's colour is multiplied by a blend from `dark` (0) to white (1).
    T_index_world
        (4, 4) affine: voxel index of an undeformed point [m]. Points outside take the value at the border.
    dark
        Colour factor (3,) at value 0.
    relief
        Height [m] of value 1 above value 0: darker is deeper. Shading only; the surface stays.
    height
        (X, Y, Z) in [0, 1]: height map of the relief, instead of `values`.

    Raises
    ------
    ValueError
        Not a finite volume of at least 2 voxels a side, or not a (4, 4) transform.
    """

    values: np.ndarray
    T_index_world: np.ndarray
    dark: tuple[float, float, float] = (0.0, 0.0, 0.0)
    relief: float = 0.0
    height: np.ndarray | None = None

    def __post_init__(self) -> None:
        values, T = np.asarray(self.values, np.float32), np.asarray(self.T_index_world, np.float64)
        if values.ndim != 3 or min(values.shape) < 2 or not np.isfinite(values).all():
            raise ValueError(f"a solid texture is a finite volume of at least 2 x 2 x 2 voxels, not {values.shape}.")
        if T.shape != (4, 4):
            raise ValueError(f"T_index_world is an affine (4, 4), not {T.shape}.")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "T_index_world", T)
        gradient = np.moveaxis(np.asarray(np.gradient(values if self.height is None else self.height)), 0, -1) @ T[
            :3, :3
        ].astype(np.float32)
        object.__setattr__(self, "texels", np.concatenate([values[..., None], gradient], axis=-1))

    # (X, Y, Z, 4) float32: value and its gradient in the world [1/m], computed once.
    texels: np.ndarray = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class Layer:
    """One surface with its appearance.

    Parameters
    ----------
    name, id
        Name; number in the segmentation, 1 .. 255 (0 is the background).
    vertices, triangles
        Vertices (V, 3) [m] and triangles (F, 3); visible from both sides.
    colour
        Colour (3,) or (V, 3), sRGB in [0, 1].
    gloss, shininess
        Strength of the wet highlight, 0 .. 1, and its Blinn–Phong exponent.
    solid, rest
        Solid texture and the material points (V, 3) [m] where it is sampled (the undeformed vertices).
    casts_shadow
        True if it casts a shadow of the lamp.
    still
        True if it never moves: a `Renderer` draws it once for a camera.

    Raises
    ------
    ValueError
        Arrays that do not fit together, an id outside 1 .. 255, or a solid texture without `rest`.
    """

    name: str
    id: int
    vertices: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray | tuple[float, float, float] = (0.8, 0.8, 0.8)
    gloss: float = 0.3
    shininess: float = 60.0
    solid: Solid | None = None
    rest: np.ndarray | None = None
    casts_shadow: bool = False
    still: bool = False

    def __post_init__(self) -> None:
        vertices, triangles = check_mesh(self.vertices, self.triangles)
        if not 1 <= self.id <= 255:
            raise ValueError(f"layer {self.name!r} has the id {self.id}: choose 1 .. 255 (0 is the background).")
        if (self.solid is None) != (self.rest is None):
            raise ValueError(f"layer {self.name!r} needs both a solid texture and its rest points, or neither.")
        colour = np.asarray(self.colour, np.float32)
        for what, array, shapes in (("colour", colour, ((3,), vertices.shape)), ("rest", self.rest, (vertices.shape,))):
            if array is not None and np.shape(array) not in shapes:
                raise ValueError(f"layer {self.name!r}: {what} has shape {np.shape(array)}, not one of {shapes}.")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)
        object.__setattr__(self, "colour", np.broadcast_to(colour, vertices.shape))


def compute_vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Compute unit vertex normals (V, 3): face normals weighted by area; zero for vertices without a triangle."""
    a, b, c = (vertices[triangles[:, k]].T for k in range(3))
    (x, y, z), (u, v, w) = b - a, c - a
    faces = y * w - z * v, z * u - x * w, x * v - y * u
    total = np.zeros(vertices.shape)
    for axis, face in enumerate(faces):
        for corner in triangles.T:
            total[:, axis] += np.bincount(corner, face, minlength=len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0.0, length, 1.0)
