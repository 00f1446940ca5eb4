"""Surgical drape with a hole over the open cortex: plain, or as cloth with folds."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import trimesh

from ar.rendering.embedding import build_embedded_surface
from ar.rendering.layer import Layer, compute_vertex_normals

from ..script.craniotomy_frame import HOLE_RATIO, CraniotomyFrame
from ..script.framing import DRAPE_HEIGHT

DRAPE_COLOUR = (0.16, 0.36, 0.42)  # Colour of the drape (RGB, 0 to 1).
DRAPE_DEPTH = 8.0e-3  # Depth of the drape's wall below the brain [m].
CLOTH_EDGE = 0.8e-3  # Largest edge of a triangle of cloth near the hole [m].
CLOTH_GROWTH = 0.35  # Growth of the largest edge with the distance from the hole, beyond `CLOTH_WIDTH`.
CLOTH_WIDTH = 30e-3  # Width of the ring of cloth round the hole with the smallest edges [m].
SMOOTHING_STEPS = 20  # Number of smoothing steps of the drape.
FOLD_COUNTS = (9, 14)  # Numbers of folds around the hole in two sets; the visible height is the larger of both.
FOLD_HEIGHT = 4.5e-3  # Height of the folds [m].
FOLD_START = 9e-3  # Distance from the hole at which the folds have their height [m].


@lru_cache(maxsize=4)
def build_drape(site: CraniotomyFrame, segment_id: int, is_folded: bool) -> Layer:
    """Build the drape: the brain surface moved outwards, with a round hole over the open cortex and a wall round it.

    If `is_folded`, the drape is cloth with soft folds that begin at the edge of the hole. The result is cached for all
    scenes of a patient.
    """
    points, triangles, rim = cut_hole(site)
    colour = np.broadcast_to(DRAPE_COLOUR, points.shape)
    if is_folded:
        points, triangles, rim, colour = fold_cloth(site, points, triangles)
    # The wall has its own vertices: normals shared with the drape would round its edge off.
    low = points[rim] + (DRAPE_HEIGHT + DRAPE_DEPTH) * site.axis
    corner = len(points) + np.arange(4 * len(rim)).reshape(-1, 4)  # two upper, two lower, of every edge
    wall = np.concatenate([corner[:, [0, 1, 3]], corner[:, [0, 3, 2]]])
    points = np.concatenate([points, np.concatenate([points[rim], low], axis=1).reshape(-1, 3)])
    colour = np.concatenate([colour, np.broadcast_to(DRAPE_COLOUR, (4 * len(rim), 3))])
    return Layer("drape", segment_id, points, np.concatenate([triangles, wall]), colour, gloss=0.05, still=True)


def cut_hole(site: CraniotomyFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the brain surface moved outwards, with a hole over the open cortex; for the arrays see `clip_surface`."""
    mesh = site.anatomy.mesh
    lifted = mesh.nodes + DRAPE_HEIGHT * compute_vertex_normals(mesh.nodes, mesh.surface)
    # Distance of a node outside the hole: across the axis on the near side, everywhere on the far side.
    far = (mesh.nodes - site.origin) @ site.axis > 2.0 * site.radius
    outside = np.where(far, site.radius, site.compute_axis_distance(mesh.nodes) - HOLE_RATIO * site.clearance)
    return clip_surface(lifted, mesh.surface, outside)


def fold_cloth(
    site: CraniotomyFrame, points: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Refine and fold a drape; return points (n, 3) [m], triangles (m, 3), hole edges (k, 2) and colours (n, 3)."""
    corners, triangles = np.unique(points[triangles].reshape(-1, 3).round(9), axis=0, return_inverse=True)
    hole = HOLE_RATIO * site.clearance

    def compute_edge_length(points: np.ndarray) -> np.ndarray:
        beyond = np.linalg.norm(points - site.origin, axis=1) - hole - CLOTH_WIDTH
        return CLOTH_EDGE + CLOTH_GROWTH * np.maximum(beyond, 0.0)

    smooth = trimesh.Trimesh(corners, triangles.reshape(-1, 3), process=False)
    rim = np.unique(list_border_edges(smooth.faces))
    trimesh.smoothing.filter_taubin(smooth, iterations=SMOOTHING_STEPS)  # cloth spans sulci
    smooth.vertices[rim] = corners[rim]
    corners = np.asarray(smooth.vertices)
    fine = build_embedded_surface(corners, triangles.reshape(-1, 3), compute_edge_length)
    arm = fine.interpolate(corners) - site.origin
    height = compute_fold_heights(np.linalg.norm(arm, axis=1) - hole, np.arctan2(arm @ site.up, arm @ site.right))
    at = replace(fine, depth=-FOLD_HEIGHT * height, max_height=1.1 * FOLD_HEIGHT).compute_vertices(corners)
    return at, fine.triangles, list_border_edges(fine.triangles), (0.9 + 0.35 * height[:, None]) * DRAPE_COLOUR


def list_border_edges(triangles: np.ndarray) -> np.ndarray:
    """List the edges (k, 2) that belong to one triangle only."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    return edges[trimesh.grouping.group_rows(edges, require_count=1)]


def compute_fold_heights(distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return relative fold heights (n,), 0 to 1, at distances (n,) [m] from the hole's edge and angles (n,) [rad]."""
    rise, away = np.clip(distance / FOLD_START, 0.0, 1.0), distance / 15e-3
    folds = []
    for count, start in zip(FOLD_COUNTS, (0.0, 2.0), strict=True):
        bend = 1.8 * np.sin(2.0 * angle + 1.0 + start) + 1.5 * np.sin(3.0 * angle - 0.8 * away + start) + 0.5 * away
        size = 0.7 + 0.3 * np.sin(4.0 * angle + 0.9 * away + 2.0 * start)
        folds.append(size * (0.5 + 0.5 * np.cos(count * angle + bend)) ** 3)
    return rise**2 * (3.0 - 2.0 * rise) * np.maximum(*folds)


def clip_surface(
    points: np.ndarray, triangles: np.ndarray, field: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clip a surface with points (V, 3) and triangles (F, 3) to the part where a linear `field` (V,) is positive.

    Returns points (n, 3), triangles (m, 3) and cut edges (k, 2). Triangles on the zero line are cut along this line.
    """
    positive = field[triangles] > 0.0
    whole = triangles[positive.all(axis=1)]
    mixed = triangles[positive.any(axis=1) & ~positive.all(axis=1)]
    added, pieces, rim = [], [], []
    for corners in mixed:
        inside = field[corners] > 0.0
        # Permute the corners so that the corner alone on its side comes first.
        lone = int(np.argmax(inside) if inside.sum() == 1 else np.argmin(inside))
        a, b, c = np.roll(corners, -lone)
        cuts = []
        for other in (b, c):
            share = field[a] / (field[a] - field[other])
            cuts.append(len(points) + len(added))
            added.append((1.0 - share) * points[a] + share * points[other])
        if field[a] > 0.0:
            pieces.append([[a, cuts[0], cuts[1]]])
        else:
            pieces.append([[cuts[0], b, c], [cuts[0], c, cuts[1]]])
        rim.append(cuts)
    parts = [whole, *(np.array(piece) for piece in pieces)]
    return (
        np.concatenate([points, *(point[None] for point in added)]),
        np.concatenate(parts),
        np.array(rim).reshape(-1, 2),
    )
