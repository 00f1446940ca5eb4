"""Bone surface over the nodes of a brain surface, and its edge at the craniotomy."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.special import ndtri

from ...anatomy import Anatomy
from ...discretisation.space import Discretisation
from ...errors import InputError
from ...geometry.surface import (
    BlurRange,
    compute_areas,
    compute_blurred_normals,
    compute_edge_lengths,
    normalise_vectors,
)

# Distance [m] inside the craniotomy assigned to nodes under bone, so that these stay covered wherever they move.
COVERED_DISTANCE = -1.0
# Area fractions of a quadratic triangle's nodes: all positive, so that every node has an area.
CORNER_SHARE = 1.0 / 12.0  # each corner
MIDPOINT_SHARE = 1.0 / 4.0  # each midpoint


@dataclass(frozen=True)
class BoneSettings:
    """Activation distance of skull contact, and estimation of the bone's curvature and edge from a mesh.

    Parameters
    ----------
    activation
        Maximum activation distance [m]; smaller if the gap is narrower.
    edge_activation
        Activation distance at the craniotomy's edge, as a fraction of the edge radius, which depends on the mesh size.
        At a sharp or stiff edge, nodes would snap from one side to the other.
    blur
        Standard deviation of the blur that extends the bone normals over the craniotomy [edge radii].
    neighbours, min_normal_cosine
        Number of nearest nodes for the bone's curvature at a node, and minimum cosine between their
        normals.
    max_edge_distance
        Distance from the edge beyond which the direction to the edge is unreliable [standard deviations of the blur].
    """

    activation: float = 1e-4
    edge_activation: float = 0.25
    blur: float = 1.5
    neighbours: int = 16
    min_normal_cosine: float = 0.5
    max_edge_distance: float = 2.5


BONE_SETTINGS = BoneSettings()
"""Default bone settings."""


@dataclass(frozen=True, eq=False)
class Bone:
    """Bone over k nodes of a surface.

    Parameters
    ----------
    nodes
        Node numbers (k,).
    normal, curvature
        Unit vectors (k, 3) towards the bone, and their positive semi-definite derivatives (k, 3, 3) [1/m] along it.
    inside_distance, inward
        Distances (k,) [m] inside the craniotomy, negative under bone; unit vectors (k, 3) into the craniotomy, or zero
        far from its edge.
    activation, area
        Activation distances (k,) [m], and tributary areas (k,) [m^2].
    gap
        Undeformed distance between surface and bone [m].
    edge_radius
        Radius of the craniotomy's edge [m].
    """

    nodes: np.ndarray
    normal: np.ndarray
    curvature: np.ndarray
    inside_distance: np.ndarray
    inward: np.ndarray
    activation: np.ndarray
    area: np.ndarray
    gap: float
    edge_radius: float


def build_bone(anatomy: Anatomy, space: Discretisation, gap: float, settings: BoneSettings = BONE_SETTINGS) -> Bone:
    """Return the bone over all covered nodes and over craniotomy nodes near the edge, except fixed nodes.

    Raises
    ------
    InputError
        The anatomy has no nodes that can touch the skull.
    """
    fixed = space.extend_fixed(anatomy.fixed).all(axis=1)
    normal = space.extend_normals(anatomy.slide_normal, anatomy.fixed)
    slides = (normal != 0.0).any(axis=1) & ~fixed
    if not slides.any():
        raise InputError("SkullContact finds no node that can touch: all slide normals are zero, or their nodes fixed.")
    inside, way = np.full(space.count, COVERED_DISTANCE), np.zeros_like(normal)
    activation = np.full(space.count, min(settings.activation, gap))
    edge, rim = 0.0, find_opening_edge(anatomy)
    if len(rim):
        opened = np.zeros(space.count, bool)
        opened[
            space.surface[find_triangles_about_opening(anatomy) & anatomy.craniotomy[space.mesh.surface].any(axis=1)]
        ] = True
        opened &= ~slides & ~fixed
        edge = compute_edge_radius(space.nodes, rim)
        blur, points = settings.blur * edge, space.nodes[opened]
        normal[opened] = compute_blurred_normals(space.nodes, space.surface[:, :3], points, blur)
        r, way[opened] = measure_inside_opening(anatomy, points, normal[opened], edge, settings.max_edge_distance)
        inside[opened], activation[opened] = r.clip(0.0), settings.edge_activation * edge
    nodes = np.flatnonzero(slides | (way != 0.0).any(axis=1))
    return Bone(
        nodes=nodes,
        normal=normal[nodes],
        curvature=compute_curvature(space.nodes[nodes], normal[nodes], settings),
        inside_distance=inside[nodes],
        inward=way[nodes],
        activation=activation[nodes],
        area=_compute_nodal_areas(space)[nodes],
        gap=gap,
        edge_radius=edge,
    )


def _compute_nodal_areas(space: Discretisation) -> np.ndarray:
    """Return the tributary area (N,) [m^2] of each node on the surface."""
    area = compute_areas(space.nodes[space.surface[:, :3]])
    shares = np.full(3, 1.0 / 3.0) if space.surface.shape[1] == 3 else np.repeat([CORNER_SHARE, MIDPOINT_SHARE], 3)
    return np.bincount(space.surface.ravel(), (area[:, None] * shares).ravel(), space.count)


def compute_curvature(points: np.ndarray, normal: np.ndarray, settings: BoneSettings = BONE_SETTINGS) -> np.ndarray:
    """Return estimated symmetric derivatives (k, 3, 3) [1/m] of unit normals (k, 3) along a wall, at points (k, 3) [m].

    The derivative H is a least-squares fit of n_j - n_i = H (x_j - x_i) in the tangent plane, to the nearest points
    with similar normals. Negative (concave) principal curvatures are set to 0.
    """
    count = min(settings.neighbours, len(points))
    near = KDTree(points).query(points, count)[1].reshape(len(points), count)
    across = np.linalg.svd(normal[:, None])[2][:, 1:]  # two tangents of the wall
    step = np.einsum("kja,kia->kij", across, points[near] - points[:, None])
    turn = np.einsum("kja,kia->kij", across, normal[near] - normal[:, None])
    weight = np.einsum("kia,ka->ki", normal[near], normal) > settings.min_normal_cosine
    x, y = np.moveaxis(step * weight[:, :, None], 2, 0)
    none = np.zeros_like(x)
    # Unknowns H_xx, H_xy, H_yy.
    rows = np.stack([np.stack([x, y, none], axis=2), np.stack([none, x, y], axis=2)], axis=2).reshape(
        len(points), -1, 3
    )
    found = np.linalg.pinv(rows) @ (turn * weight[:, :, None]).reshape(len(points), -1, 1)
    flat = found[:, [0, 1, 1, 2], 0].reshape(-1, 2, 2)
    values, vectors = np.linalg.eigh(flat)
    along = np.einsum("kja,kjm->kam", across, vectors)
    return np.einsum("kam,km,kbm->kab", along, values.clip(0.0), along)


def find_opening_edge(anatomy: Anatomy) -> np.ndarray:
    """Return the surface triangles (R, 3) at the craniotomy's edge, with corners in the craniotomy and under bone."""
    around = anatomy.mesh.surface[find_triangles_about_opening(anatomy)]
    opened = anatomy.craniotomy[around]
    return around[opened.any(axis=1) & ~opened.all(axis=1)]


def compute_edge_radius(nodes: np.ndarray, edge_nodes: np.ndarray) -> float:
    """Return the edge radius [m] that the triangles `edge_nodes` (R, 3) resolve: their mean edge length."""
    return float(compute_edge_lengths(nodes[edge_nodes]).mean())


def measure_inside_opening(
    anatomy: Anatomy,
    points: np.ndarray,
    normal: np.ndarray,
    blur: float,
    cutoff: float = BONE_SETTINGS.max_edge_distance,
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (n,) [m] of surface points (n, 3) [m] inside the craniotomy, and inward directions (n, 3).

    Distances are negative under bone. Directions are unit vectors perpendicular to the unit normals (n, 3), or zero
    more than `cutoff` blurs from the edge.

    A Gaussian of standard deviation `blur` [m], at a distance r inside a straight edge, has the fraction Phi(r / blur)
    in the craniotomy; r follows by inversion.
    """
    mesh, opened = anatomy.mesh, anatomy.craniotomy
    triangles = mesh.surface[find_triangles_about_opening(anatomy)]
    a, b, c = np.moveaxis(mesh.nodes[triangles], 1, 0)
    twice, middle, bare = np.cross(b - a, c - a), (a + b + c) / 3.0, opened[triangles].mean(axis=1)
    seen = KDTree(points).sparse_distance_matrix(KDTree(middle), BlurRange.cutoff * blur, output_type="coo_matrix")
    # exclude the opposite side of a thin body
    facing = np.einsum("ki,ki->k", normal[seen.row], twice[seen.col]).clip(0.0)
    seen.data = facing * np.exp(-0.5 * (seen.data / blur) ** 2)
    seen = seen.tocsr()
    whole, part = seen @ np.ones(len(bare)), seen @ bare
    share = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0.0)
    # gradient of `share`, up to a positive factor
    uphill = seen @ (middle * bare[:, None]) - share[:, None] * (seen @ middle)
    across = normalise_vectors(uphill - (uphill * normal).sum(axis=1, keepdims=True) * normal)
    inside = ndtri(share).clip(-cutoff, cutoff)
    return blur * inside, np.where(np.abs(inside[:, None]) < cutoff, across, 0.0)


def find_triangles_about_opening(anatomy: Anatomy) -> np.ndarray:
    """Return a mask (S,) of the surface triangles all of whose corners are in the craniotomy or under bone."""
    covered = np.logical_or(anatomy.slide_normal.any(axis=1), anatomy.fixed.all(axis=1))
    return np.all(np.logical_or(anatomy.craniotomy, covered)[anatomy.mesh.surface], axis=1)
