"""Surfaces to render, with their colour, highlight and texture."""

from dataclasses import dataclass

import numpy as np

from .rasteriser import check_mesh


@dataclass(frozen=True, eq=False)
class Solid:
    """Solid texture: a grey volume, sampled for each pixel at the material points `Layer.rest`.

    Parameters
    ----------
    values
        Values (X, Y, Z) in [0, 1]; they multiply the layer's colour by a factor from `dark` (0) to white (1).
    T_index_world
        Affine transform (4, 4) from undeformed points [m] to voxel indices. Points outside get the value at the border.
    dark
        Colour factor (3,) at value 0.
    relief
        Height [m] of value 1 above value 0, for shading only; the surface itself is unchanged.
    height
        Height map (X, Y, Z) in [0, 1] of the relief; None: `values`.

    Raises
    ------
    ValueError
        The volume is not finite or has fewer than 2 voxels along a side, or the transform is not (4, 4).
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
    """Surface to render, with its appearance.

    Parameters
    ----------
    name, id
        Name, and number in the segmentation from 1 to 255 (0 is the background).
    vertices, triangles
        Vertices (V, 3) [m] and triangles (F, 3); visible from both sides.
    colour
        Colour (3,) or (V, 3), sRGB in [0, 1].
    gloss, shininess
        Strength of the wet highlight, from 0 to 1, and its Blinn-Phong exponent.
    solid, rest
        Solid texture, and the material points (V, 3) [m] at which it is sampled (the undeformed vertices).
    casts_shadow
        True if the layer casts a shadow of the lamp.
    still
        True if the layer never moves; a `Renderer` then draws it once per camera.

    Raises
    ------
    ValueError
        Arrays do not fit together, the id is outside 1 .. 255, or only one of `solid` and `rest` is given.
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
    """Compute unit vertex normals (V, 3), the area-weighted mean of face normals; zero for vertices without a face."""
    a, b, c = (vertices[triangles[:, k]].T for k in range(3))
    (x, y, z), (u, v, w) = b - a, c - a
    faces = y * w - z * v, z * u - x * w, x * v - y * u
    total = np.zeros(vertices.shape)
    for axis, face in enumerate(faces):
        for corner in triangles.T:
            total[:, axis] += np.bincount(corner, face, minlength=len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0.0, length, 1.0)
