"""Details drawn on the open cortex: vessels, squares of cotton that move with the cortex, and a gloved finger."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import affine_transform, gaussian_filter
from scipy.spatial import KDTree

from ar.rendering.layer import Layer, Solid
from sim.bodies.intensity import Intensity
from sim.geometry.surface import normalise_vectors

from ..script.craniotomy_frame import CraniotomyFrame
from ..script.tool import build_capsule
from ..script.viewpoint import Cottonoid


@dataclass(frozen=True)
class VesselSettings:
    """Settings of `add_vessels`."""

    voxel_across: float = 0.2e-3  # Edge of a voxel across the axis of the craniotomy [m].
    voxel_along: float = 1e-3  # Edge of a voxel along the axis of the craniotomy [m].
    border_width: float = 10e-3  # Margin of the voxels round the craniotomy [m].
    height_above: float = 5e-3  # Height of the voxels above the centre of the craniotomy [m].
    depth_below: float = 14e-3  # Depth of the voxels below the centre of the craniotomy [m].
    trunk_count: int = 14  # Number of vessels that enter at the border.
    max_width: float = 0.8e-3  # Largest width of a vessel [m].
    min_trunk_ratio: float = 0.5  # Smallest width of a vessel at the border relative to the largest.
    min_width: float = 0.2e-3  # Width at which a vessel ends [m].
    step: float = 0.2e-3  # Step of a vessel's path [m].
    branch_probability: float = 0.05  # Probability of a branch in each step.
    turn_deviation: float = 0.12  # Standard deviation of the turn in each step [rad].
    width_factor: float = 0.998  # Factor on the width in each step.
    branch_width_ratio: float = 0.72  # Width of a branch relative to its parent.
    max_absorption: float = 0.75  # Largest share of the light that a vessel absorbs.
    mottle_contrast: float = 0.12  # Contrast of the mottle: vessels too fine to be drawn.
    mottle_length: float = 0.35e-3  # Length scale of the mottle [m].


VESSELS = VesselSettings()


@lru_cache(maxsize=2)
def add_vessels(
    intensity: Intensity | None, site: CraniotomyFrame, seed: int, absorption: tuple[float, float, float], relief: float
) -> Solid:
    """Return a solid texture of the scan around the craniotomy, with random vessels that `seed` determines.

    Vessels move with the tissue and have no height. Without a scan, the brightness is uniform. See `Solid` for
    `absorption` and `relief`.
    """
    half = site.radius + VESSELS.border_width
    wide, tall = VESSELS.voxel_across, VESSELS.voxel_along
    across, along = np.arange(-half, half, wide), np.arange(-VESSELS.height_above, VESSELS.depth_below, tall)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([wide * site.right, wide * site.up, tall * site.axis])
    T[:3, 3] = site.origin + across[0] * (site.right + site.up) + along[0] * site.axis
    scan = np.ones((len(across), len(across), len(along)), np.float32)
    if intensity is not None:
        grey, inside = intensity.apply_window(site.anatomy.mesh), np.linalg.inv(intensity.affine) @ T
        scan = affine_transform(grey, inside, output_shape=scan.shape, order=1, mode="nearest")
    light = 1.0 - compute_vessel_absorption(across, np.random.default_rng([seed, 1])).astype(np.float32)
    return Solid(scan * light[:, :, None], np.linalg.inv(T), absorption, relief, height=scan)


def compute_vessel_absorption(
    coordinates: np.ndarray, random: np.random.Generator, settings: VesselSettings = VESSELS
) -> np.ndarray:
    """Compute the share (n, n) of light that vessels absorb, on a square grid with ticks `coordinates` (n,) [m]."""
    points, widths = sample_vessel_paths(float(np.abs(coordinates).max()), random, settings)
    here = np.stack(np.meshgrid(coordinates, coordinates, indexing="ij"), axis=-1)
    away, nearest = KDTree(points).query(here, distance_upper_bound=2.0 * settings.max_width)
    width = np.append(widths, settings.max_width)[nearest]
    vessels = settings.max_absorption * np.exp(-2.0 * (away / width) ** 2)
    mottle = gaussian_filter(random.standard_normal(away.shape), settings.mottle_length / settings.voxel_across)
    return np.clip(vessels + (1.0 - vessels) * settings.mottle_contrast * mottle / mottle.std(), 0.0, 0.95)


def sample_vessel_paths(
    half_width: float, random: np.random.Generator, settings: VesselSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Sample branching vessels that enter a square at its border; return points (k, 2) [m] and widths (k,) [m]."""
    count = settings.trunk_count
    angles = 2.0 * np.pi * (np.arange(count) + random.uniform(0.0, 0.7, count)) / count
    rim = half_width * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = list(
        zip(rim, angles + np.pi, settings.max_width * random.uniform(settings.min_trunk_ratio, 1.0, count), strict=True)
    )
    points, widths = [], []
    while ends:
        at, way, width = ends.pop()
        while width > settings.min_width and np.abs(at).max() <= half_width:
            points.append(at)
            widths.append(width)
            way = way + settings.turn_deviation * random.standard_normal()
            at, width = at + settings.step * np.array([np.cos(way), np.sin(way)]), settings.width_factor * width
            if random.uniform() < settings.branch_probability:
                side = random.choice([-1.0, 1.0])
                ends.append((at, way + side * random.uniform(0.5, 1.2), settings.branch_width_ratio * width))
                way, width = way - 0.2 * side, 0.95 * width
    return np.array(points), np.array(widths)


COTTON, GLOVE = 5, 6
"""Segmentation ids."""
COTTON_COLOUR, GLOVE_COLOUR = (0.93, 0.92, 0.88), (0.86, 0.80, 0.66)  # Colours (RGB, 0 to 1).
SQUARE_VERTICES = 9  # Number of vertices along a side of a cotton square.
SQUARE_HEIGHT = 0.7e-3  # Height of a cotton square above the cortex [m].


@dataclass(frozen=True)
class FingerSettings:
    """Settings of `build_finger`."""

    radius: float = 7e-3  # Radius of a finger [m].
    length: float = 70e-3  # Length of a finger [m].
    overhang: float = 4e-3  # Length of a finger beyond the edge of the craniotomy [m].
    height: float = 7e-3  # Height of a finger above the cortex [m].


@dataclass(frozen=True, eq=False)
class CottonoidSurface:
    """Squares of cotton on the cortex: mesh vertices and weights (n, 3) of n points, and triangles (m, 3) of points."""

    vertices: np.ndarray
    weights: np.ndarray
    triangles: np.ndarray
    offsets: np.ndarray

    def build_layer(self, positions: np.ndarray) -> Layer:
        """Return the rendered layer of the squares for mesh vertices at `positions` (V, 3) [m]."""
        carried = np.einsum("nk,nkd->nd", self.weights, positions[self.vertices])
        return Layer("cotton", COTTON, carried + self.offsets, self.triangles, COTTON_COLOUR, gloss=0.1)


def build_cottonoids(site: CraniotomyFrame, cottonoids: Sequence[Cottonoid]) -> CottonoidSurface:
    """Build the surface of squares of cotton that lie on the open cortex."""
    steps = np.linspace(-0.5, 0.5, SQUARE_VERTICES)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = (each.ravel() for each in np.meshgrid(*[np.arange(SQUARE_VERTICES - 1)] * 2, indexing="ij"))
    a, b, c, d = (SQUARE_VERTICES * (i + p) + j + q for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack(each, axis=1) for each in ((a, b, c), (a, c, d))])
    places, triangles = [], []
    for each in cottonoids:
        turn = np.array([[np.cos(each.angle), -np.sin(each.angle)], [np.sin(each.angle), np.cos(each.angle)]])
        at = each.side * grid @ turn.T + (each.x, each.y)
        triangles.append(faces + len(places))
        places += [site.find_nearest(site.origin + x * site.right + y * site.up) for x, y in at]
    return CottonoidSurface(
        np.array([place.vertices for place in places]), np.array([place.weights for place in places]),
        np.concatenate(triangles), -SQUARE_HEIGHT * np.array([place.inward for place in places]),
    )  # fmt: skip


def build_finger(site: CraniotomyFrame, angle: float, settings: FingerSettings = FingerSettings()) -> Layer:
    """Build the layer of a static gloved finger over the craniotomy edge, at an angle in the tangent plane [rad]."""
    out = np.cos(angle) * site.right + np.sin(angle) * site.up
    tip = site.origin + (site.clearance - settings.overhang) * out - settings.height * site.axis
    way = normalise_vectors((out - 0.35 * site.axis)[None])[0]
    side = normalise_vectors(np.cross(way, site.axis)[None])[0]
    vertices, triangles = build_capsule(settings.radius, settings.length)
    turned = vertices @ np.stack([side, np.cross(way, side), way])
    return Layer("glove", GLOVE, turned + tip, triangles, GLOVE_COLOUR, gloss=0.3, still=True)
