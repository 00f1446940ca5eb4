"""Relocation of nodes after isosurface stuffing, to fit surfaces to level sets and to improve dihedral angles."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..geometry.surface import compute_areas
from ..geometry.tetmesh import EDGES, FACES
from .signed_distance import Field, project_onto_level

Projection = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function that returns the admissible points (n, 3) [m] nearest to given points (n, 3) [m] of the nodes (n,)."""

# The two faces that meet at each edge of a tetrahedron (face k is opposite corner k).
EDGE_FACES = np.array([[2, 3], [1, 3], [1, 2], [0, 3], [0, 2], [0, 1]])
DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1.0  # 26 unit directions of a trial move
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@dataclass(frozen=True)
class Smoothing:
    """Limits of the node moves that fit surfaces and improve angles.

    Parameters
    ----------
    good_angle
        Tetrahedra are bad if a dihedral angle is below `good_angle` or above 180 - `good_angle` [degrees].
    max_iterations
        Maximum number of iterations.
    max_shift
        Maximum distance of a node from its surface to improve the fit [m]: half a voxel, the image resolution.
    first_step, min_step
        Initial step and minimum step, as fractions of the shortest edge at a node; smaller moves are not tried.
    """

    good_angle: float = 18.0
    max_iterations: int = 60
    max_shift: float = 5e-4
    first_step: float = 0.3
    min_step: float = 0.02

    @property
    def good_sine(self) -> float:
        """Sine of `good_angle`."""
        return float(np.sin(np.radians(self.good_angle)))


def compute_smallest_sines(corners: np.ndarray) -> np.ndarray:
    """Return the smallest sine (...,) of the dihedral angles of each tetrahedron in `corners` (..., 4, 3).

    The sine is negative for inverted tetrahedra, and small near 0 and 180 degrees (Klingner & Shewchuk 2007).
    """
    faces = corners[..., FACES, :]
    normals = np.cross(faces[..., 1, :] - faces[..., 0, :], faces[..., 2, :] - faces[..., 0, :])
    areas = np.linalg.norm(normals, axis=-1)
    lengths = np.linalg.norm(corners[..., EDGES[:, 1], :] - corners[..., EDGES[:, 0], :], axis=-1)
    six_volumes = -np.einsum("...i,...i->...", normals[..., 3, :], corners[..., 3, :] - corners[..., 0, :])
    product = np.maximum(areas[..., EDGE_FACES[:, 0]] * areas[..., EDGE_FACES[:, 1]], 1e-300)
    return (six_volumes[..., None] * lengths / product).min(axis=-1)


def fit_nodes(
    nodes: np.ndarray,
    triangles: np.ndarray,
    field: Field,
    movable_mask: np.ndarray,
    volume: float | None = None,
    settings: Smoothing = Smoothing(),
) -> np.ndarray:
    """Return nodes (V, 3) [m], of which `movable_mask` ones are moved to fit the closed surface `triangles` to `field`.

    A triangle with its corners on a curved surface is on the concave side. Each node therefore moves by the mean
    deviation of its triangles. The mean is 3/4 of the value at the centroid, since the deviation is quadratic and zero
    at the corners. If a `volume` [m^3] is given, a uniform shift corrects the enclosed volume.
    """
    on = np.unique(triangles)
    on = on[movable_mask[on]]
    if len(on) == 0:
        return nodes
    middle, area = _compute_centres_and_areas(nodes, triangles)
    weight, total = np.zeros(len(nodes)), np.zeros(len(nodes))
    for corner in triangles.T:
        np.add.at(weight, corner, area)
        np.add.at(total, corner, -0.75 * area * field(middle))
    most = settings.max_shift
    level = np.clip(total[on] / weight[on], -most, most)
    nodes = nodes.copy()
    nodes[on] = project_onto_level(field, nodes[on], level)
    if volume is not None:
        moving = movable_mask[triangles].mean(axis=1)  # a triangle sweeps volume in proportion to its movable corners
        for _ in range(2):
            _, area = _compute_centres_and_areas(nodes, triangles)
            missing = (volume - compute_enclosed_volume(nodes, triangles)) / (area @ moving)
            level = np.clip(level + missing, -most, most)
            nodes[on] = project_onto_level(field, nodes[on], level)
    return nodes


def prevent_folds(nodes: np.ndarray, new_nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Return `new_nodes` (V, 3) [m], but `nodes` at the corners of tetrahedra that the new positions would invert."""
    kept = new_nodes.copy()
    while True:
        folded = np.unique(tets[compute_smallest_sines(kept[tets]) <= 0.0])
        astray = folded[(kept[folded] != nodes[folded]).any(axis=1)]
        if len(astray) == 0:
            return kept
        kept[astray] = nodes[astray]


def compute_enclosed_volume(nodes: np.ndarray, triangles: np.ndarray) -> float:
    """Compute the volume [m^3] inside a closed surface of outward triangles (S, 3)."""
    a, b, c = (nodes[triangles[:, k]] for k in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c))) / 6.0


def _compute_centres_and_areas(nodes: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = nodes[triangles]
    return corners.mean(axis=1), compute_areas(corners)


def improve_mesh(
    nodes: np.ndarray, tets: np.ndarray, project_nodes: Projection, settings: Smoothing = Smoothing()
) -> np.ndarray:
    """Return nodes (V, 3) [m], moved until all dihedral angles are good or no bad angle improves any more.

    Each iteration moves nodes of bad tetrahedra, at most one per tetrahedron. Each node tries 26 steps and takes the
    step with the smallest sum of squared angle deficits in the adjacent tetrahedra.
    """
    nodes, good = nodes.copy(), settings.good_sine
    order = np.argsort(tets, axis=None, kind="stable")
    incident, begin = order // 4, np.searchsorted(tets.ravel()[order], np.arange(len(nodes) + 1))
    step, sines = np.full(len(nodes), settings.first_step), compute_smallest_sines(nodes[tets])
    for _ in range(settings.max_iterations):
        movers = _select_independent_nodes(tets, sines, step, settings)
        if len(movers) == 0:
            break
        counts = begin[movers + 1] - begin[movers]
        row = np.repeat(np.arange(len(movers)), counts)
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        near = incident[np.arange(len(row)) - first[row] + begin[movers][row]]
        own = tets[near] == movers[row, None]

        corners = nodes[tets[near]]
        edges = np.linalg.norm(corners - nodes[movers][row, None], axis=2)
        length = np.minimum.reduceat(np.where(own, np.inf, edges).min(axis=1), first)
        trials = nodes[movers, None] + (step[movers] * length)[:, None, None] * DIRECTIONS
        placed = project_nodes(trials.reshape(-1, 3), np.repeat(movers, len(DIRECTIONS))).reshape(trials.shape)
        astray = np.linalg.norm(placed - trials, axis=2) > (step[movers] * length)[:, None]
        trials = np.where(astray[..., None], nodes[movers, None], placed)
        tried = np.where(own[:, None, :, None], trials[row][:, :, None], corners[:, None])
        badness = np.add.reduceat(_compute_penalties(compute_smallest_sines(tried), good), first)
        best = badness.argmin(axis=1)
        better = badness.min(axis=1) < 0.99 * np.add.reduceat(_compute_penalties(sines[near], good), first)

        step[movers[~better]] *= 0.4
        moved = movers[better]
        nodes[moved] = trials[better, best[better]]
        touched = near[better[row]]
        sines[touched] = compute_smallest_sines(nodes[tets[touched]])
        around = np.unique(tets[touched])
        step[around] = np.maximum(step[around], 3.0 * settings.min_step)
    return nodes


def _select_independent_nodes(tets: np.ndarray, sines: np.ndarray, step: np.ndarray, settings: Smoothing) -> np.ndarray:
    """Return the nodes of bad tetrahedra that may still move: worst first, at most one per tetrahedron."""
    bad, worst = np.flatnonzero(sines < settings.good_sine), np.full(len(step), np.inf)
    np.minimum.at(worst, tets[bad].ravel(), np.repeat(sines[bad], 4))
    worst[step < settings.min_step] = np.inf
    movers, rank = np.flatnonzero(np.isfinite(worst)), np.full(len(step), len(step))
    rank[movers[np.argsort(worst[movers], kind="stable")]] = np.arange(len(movers))
    lowest, beaten = rank[tets].min(axis=1), np.zeros(len(step), bool)
    beaten[tets[rank[tets] > lowest[:, None]]] = True
    return movers[~beaten[movers]]


def _compute_penalties(sines: np.ndarray, good_sine: float) -> np.ndarray:
    """Return the squared deficits of the sines, the objective of node moves; squares emphasise the worst angles."""
    return np.maximum(good_sine - sines, 0.0) ** 2
