"""The bone over a brain as each node of its surface meets it, and where it ends: the rim of the opening."""

from __future__ import annotations

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

# What was under bone stays so far [m] from where it ends, and is barred wherever it goes.
UNDER_BONE = -1.0
# Of a quadratic triangle's area each corner's share, and each middle's: all positive, so that no node is forgotten.
CORNER, MIDDLE = 1.0 / 12.0, 1.0 / 4.0


@dataclass(frozen=True)
class BoneSettings:
    """From where bone is felt, and how its bend and its edge are read off a mesh.

    Parameters
    ----------
    felt
        [m] The skull is felt in the last of the gap: so far from it, or within all of a narrower one.
    edge_felt
        The edge of an opening is as round as a mesh can show, and felt from this share of its radius. On a sharp or a
        hard edge nodes would snap from above it to below.
    blur
        The blur through which bone over an opening goes on from that beside it, in the radii of the edge.
    neighbours, facing
        The wall's bend at a node is read off so many nearest nodes, of those with a larger cosine between their
        normals.
    far
        Blurs from the edge, beyond which too little of it is seen.
    """

    felt: float = 1e-4
    edge_felt: float = 0.25
    blur: float = 1.5
    neighbours: int = 16
    facing: float = 0.5
    far: float = 2.5


BONE = BoneSettings()
"""Bone as it is felt unless settings are given."""


@dataclass(frozen=True, eq=False)
class Bone:
    """What stands over k nodes of a surface.

    Parameters
    ----------
    nodes
        (k,) their numbers.
    normal, bend
        (k, 3) unit vectors towards the bone; (k, 3, 3) [1/m] how they change along it, none of them hollow.
    inside, way
        (k,) [m] how far each is inside the opening, negative under bone; (k, 3) unit vectors into it, or zero where it
        is too far.
    felt, area
        (k,) [m] how near each feels bone, [m^2] of surface that it stands for.
    gap
        [m] between them at rest.
    edge
        [m], the radius of the opening's edge.
    """

    nodes: np.ndarray
    normal: np.ndarray
    bend: np.ndarray
    inside: np.ndarray
    way: np.ndarray
    felt: np.ndarray
    area: np.ndarray
    gap: float
    edge: float


def build_bone(anatomy: Anatomy, space: Discretisation, gap: float, settings: BoneSettings = BONE) -> Bone:
    """Over what a skull covers, and over the craniotomy near its edge; `gap` [m] at rest. Held nodes stay.

    Raises
    ------
    InputError
        An anatomy none of whose nodes could touch.
    """
    held = space.held(anatomy.held).all(axis=1)
    normal = space.sliding(anatomy.slide_normal, anatomy.held)
    slides = (normal != 0.0).any(axis=1) & ~held
    if not slides.any():
        raise InputError(
            "SkullContact finds no node that could touch: this anatomy has no slide normals, or holds all."
        )
    inside, way = np.full(space.count, UNDER_BONE), np.zeros_like(normal)
    felt = np.full(space.count, min(settings.felt, gap))
    edge, rim = 0.0, find_opening_edge(anatomy)
    if len(rim):
        opened = np.zeros(space.count, bool)
        opened[
            space.surface[find_triangles_about_opening(anatomy) & anatomy.craniotomy[space.mesh.surface].any(axis=1)]
        ] = True
        opened &= ~slides & ~held
        edge = compute_edge_radius(space.nodes, rim)
        blur, points = settings.blur * edge, space.nodes[opened]
        normal[opened] = compute_blurred_normals(space.nodes, space.surface[:, :3], points, blur)
        r, way[opened] = measure_inside_opening(anatomy, points, normal[opened], edge, settings.far)
        inside[opened], felt[opened] = r.clip(0.0), settings.edge_felt * edge
    nodes = np.flatnonzero(slides | (way != 0.0).any(axis=1))
    return Bone(
        nodes=nodes,
        normal=normal[nodes],
        bend=bend_of(space.nodes[nodes], normal[nodes], settings),
        inside=inside[nodes],
        way=way[nodes],
        felt=felt[nodes],
        area=_areas(space)[nodes],
        gap=gap,
        edge=edge,
    )


def _areas(space: Discretisation) -> np.ndarray:
    """Of the surface, what each node (N,) [m^2] stands for."""
    area = compute_areas(space.nodes[space.surface[:, :3]])
    shares = np.full(3, 1.0 / 3.0) if space.surface.shape[1] == 3 else np.repeat([CORNER, MIDDLE], 3)
    return np.bincount(space.surface.ravel(), (area[:, None] * shares).ravel(), space.count)


def bend_of(points: np.ndarray, normal: np.ndarray, settings: BoneSettings = BONE) -> np.ndarray:
    """How unit normals (k, 3) at points (k, 3) [m] of a wall change along it: (k, 3, 3) [1/m], symmetric.

    The least-squares fit of n_j - n_i = H (x_j - x_i) to the nearest points whose normals face the same way, along the
    wall alone. Where the wall is hollow (a negative curvature) it counts as flat.
    """
    count = min(settings.neighbours, len(points))
    near = KDTree(points).query(points, count)[1].reshape(len(points), count)
    across = np.linalg.svd(normal[:, None])[2][:, 1:]  # two directions along the wall
    step = np.einsum("kja,kia->kij", across, points[near] - points[:, None])
    turn = np.einsum("kja,kia->kij", across, normal[near] - normal[:, None])
    weight = np.einsum("kia,ka->ki", normal[near], normal) > settings.facing
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
    """Surface triangles (R, 3) that the edge of the craniotomy crosses: part open, part under bone."""
    around = anatomy.mesh.surface[find_triangles_about_opening(anatomy)]
    opened = anatomy.craniotomy[around]
    return around[opened.any(axis=1) & ~opened.all(axis=1)]


def compute_edge_radius(nodes: np.ndarray, rim: np.ndarray) -> float:
    """How round [m] an edge looks across triangles (R, 3) of nodes (V, 3) [m]: as theirs are long, on average."""
    return float(compute_edge_lengths(nodes[rim]).mean())


def measure_inside_opening(
    anatomy: Anatomy, points: np.ndarray, normal: np.ndarray, blur: float, far: float = BONE.far
) -> tuple[np.ndarray, np.ndarray]:
    """How far (n,) [m] points (n, 3) [m] of the surface are inside the craniotomy, and which way its middle is (n, 3).

    Negative under bone. The way is of unit length and across the points' unit normals (n, 3); it is zero more than
    `far` blurs from the edge.

    Of a straight edge a Gaussian of standard deviation `blur` [m] leaves the share Phi(r / blur) of what is open to a
    point that is r inside. That is inverted.
    """
    mesh, opened = anatomy.mesh, anatomy.craniotomy
    triangles = mesh.surface[find_triangles_about_opening(anatomy)]
    a, b, c = np.moveaxis(mesh.nodes[triangles], 1, 0)
    twice, middle, bare = np.cross(b - a, c - a), (a + b + c) / 3.0, opened[triangles].mean(axis=1)
    seen = KDTree(points).sparse_distance_matrix(KDTree(middle), BlurRange.reach * blur, output_type="coo_matrix")
    # The other side of a thin body is not seen.
    facing = np.einsum("ki,ki->k", normal[seen.row], twice[seen.col]).clip(0.0)
    seen.data = facing * np.exp(-0.5 * (seen.data / blur) ** 2)
    seen = seen.tocsr()
    whole, part = seen @ np.ones(len(bare)), seen @ bare
    share = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0.0)
    # The share's gradient, but for a positive factor.
    uphill = seen @ (middle * bare[:, None]) - share[:, None] * (seen @ middle)
    across = normalise_vectors(uphill - (uphill * normal).sum(axis=1, keepdims=True) * normal)
    inside = ndtri(share).clip(-far, far)
    return blur * inside, np.where(np.abs(inside[:, None]) < far, across, 0.0)


def find_triangles_about_opening(anatomy: Anatomy) -> np.ndarray:
    """(S,) bool: surface triangles whose corners all lie in the craniotomy or under bone."""
    covered = np.logical_or(anatomy.slide_normal.any(axis=1), anatomy.held.all(axis=1))
    return np.all(np.logical_or(anatomy.craniotomy, covered)[anatomy.mesh.surface], axis=1)
