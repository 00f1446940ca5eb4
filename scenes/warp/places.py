"""Grid spacing of displacement fields, errors of the fields relative to FEM, and regions where FEM folds."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sim.errors import InputError
from sim.fields.warp_fields import WarpFields, build_warp_grid, compute_warp_fields
from sim.geometry.tetmesh import compute_signed_volumes

from .deformed_anatomy import DeformedAnatomy
from .landmarks import Landmark, list_landmarks

# Weights of corners at the places inside a tetrahedron; no field is fitted there.
INNER_WEIGHTS = 0.55 * np.eye(4) + 0.15 * (1.0 - np.eye(4))
# Weights of corners at the places inside a triangle; no field is fitted there.
FACE_WEIGHTS = 0.58 * np.eye(3) + 0.21 * (1.0 - np.eye(3))
MIN_SPACING = 0.3e-3  # Smallest spacing of a field [m].
MAX_SPACING = 5e-3  # Largest spacing of a field [m].
MAX_REQUESTED_NODES = 96_000_000  # Maximum number of nodes at a spacing given by the user.


@dataclass(frozen=True)
class SpacingSettings:
    """Settings of the search for a grid spacing in `compute_fields`."""

    first: float = 1e-3  # Spacing that is tried first [m].
    tolerance: float = 0.05e-3  # Tolerance of the error of tumour and landmarks in the search for a spacing [m].
    max_nodes: int = 32_000_000  # Maximum number of nodes in the search for a spacing. A million take 12 MB of memory.
    step: float = 0.05e-3  # Step of the spacing in the search [m].
    safety_factor: float = 0.95  # Safety factor of the spacing in the search.
    max_trials: int = 3  # Maximum number of trials in the search for a spacing.


@dataclass(frozen=True, eq=False)
class SamplePoints:
    """Sample points: vertices of a mesh, points in its tetrahedra and on the open cortex, and landmarks.

    Parameters
    ----------
    rest, displacement
        Positions (n, 3) [m] in the scan, and displacements (n, 3) [m].
    tumour, cortex, landmarks
        Masks (n,), which are True for points of the tumour, for points of the open cortex, and for landmarks.
    named
        Landmarks, in the order of their points.
    """

    rest: np.ndarray
    displacement: np.ndarray
    tumour: np.ndarray
    cortex: np.ndarray
    landmarks: np.ndarray
    named: tuple[Landmark, ...]

    def compute_errors(self, fields: WarpFields) -> np.ndarray:
        """Return the error (n,) [m] relative to FEM at each point: the larger of the errors of both fields."""
        grid, now = fields.grid, self.rest + self.displacement
        forward = grid.interpolate(fields.forward, self.rest) - self.displacement
        backward = grid.interpolate(fields.backward, now) + self.displacement
        return np.maximum(np.linalg.norm(forward, axis=1), np.linalg.norm(backward, axis=1))


def list_points(deformed_anatomy: DeformedAnatomy) -> SamplePoints:
    """Return the vertices, 4 points per tetrahedron and 3 per open triangle of the remaining mesh, and landmarks."""
    body, mesh = deformed_anatomy.remaining, deformed_anatomy.remaining.mesh
    used, marks = np.unique(mesh.tets), list_landmarks(body, deformed_anatomy.displacement)
    within, on = len(INNER_WEIGHTS) * len(mesh.tets), len(FACE_WEIGHTS) * len(body.open_surface)
    part = np.repeat(np.arange(4), [len(used), within, on, len(marks)])

    def evaluate_points(values: np.ndarray, landmarks: list[np.ndarray]) -> np.ndarray:
        between = (
            (INNER_WEIGHTS @ values[mesh.tets]).reshape(-1, 3),
            (FACE_WEIGHTS @ values[body.open_surface]).reshape(-1, 3),
        )
        return np.concatenate([values[used], *between, np.reshape(landmarks, (-1, 3))])

    tumour, cortex = np.zeros((2, len(part)), bool)
    tumour[part == 0] = np.isin(used, body.tumour_nodes)
    tumour[part == 1] = np.repeat(body.in_tumour, len(INNER_WEIGHTS))
    cortex[part == 0], cortex[part == 2] = np.isin(used, body.open_surface), True
    rest = evaluate_points(mesh.nodes, [one.rest for one in marks])
    moved = evaluate_points(deformed_anatomy.displacement, [one.deformed - one.rest for one in marks])
    return SamplePoints(rest, moved, tumour, cortex, part == 3, marks)


@dataclass(frozen=True)
class FoldedRegion:
    """Region of connected inverted tetrahedra: their number, centre [m, RAS] and volume [m^3] in the scan.

    `field_error` is the maximum error [m] of the fields relative to FEM there, since no field can represent a fold.
    """

    tetrahedra: int
    centre: tuple[float, ...]
    volume: float
    field_error: float


def find_folds(deformed_anatomy: DeformedAnatomy, fields: WarpFields) -> tuple[FoldedRegion, ...]:
    """Return all regions where FEM folds, largest first."""
    mesh = deformed_anatomy.remaining.mesh
    bad = mesh.tets[compute_signed_volumes(mesh.nodes + deformed_anatomy.displacement, mesh.tets) <= 0.0]
    if not len(bad):
        return ()
    count = len(bad)
    sides = np.repeat(np.arange(count), 4), count + bad.ravel()
    graph = coo_matrix((np.ones(4 * count), sides), (count + len(mesh.nodes),) * 2)
    groups = connected_components(graph, directed=False)[1][:count]
    errors = list_points(deformed_anatomy).compute_errors(fields)
    off = np.zeros(len(mesh.nodes))
    used = np.unique(mesh.tets)
    off[used] = errors[: len(used)]
    found = []
    for group in np.unique(groups):
        tets = bad[groups == group]
        volumes = compute_signed_volumes(mesh.nodes, tets)
        middle = np.average(mesh.nodes[tets].mean(axis=1), axis=0, weights=volumes)
        found.append(FoldedRegion(len(tets), tuple(middle.tolist()), float(volumes.sum()), float(off[tets].max())))
    return tuple(sorted(found, key=lambda fold: -fold.volume))


def count_steps(spacing: float | None, settings: SpacingSettings = SpacingSettings()) -> int:
    """Return the number of steps of `compute_fields`, which are two fields for each tried spacing."""
    return 2 * (1 + (settings.max_trials if spacing is None else 0))


def compute_fields(
    deformed: DeformedAnatomy,
    spacing: float | None,
    step: Callable[[int], object],
    settings: SpacingSettings = SpacingSettings(),
) -> WarpFields:
    """Compute the fields at a spacing [m]; None: 1 mm, or less until the errors of tumour and landmarks are small.

    `step` receives the number of newly finished steps, see `count_steps`.

    Raises
    ------
    InputError
        The grid with this spacing has too many nodes.
    """
    if spacing is not None and (nodes := _count_nodes(deformed, spacing)) > MAX_REQUESTED_NODES:
        raise InputError(
            f"--spacing {1e3 * spacing:g}: the fields would have {nodes / 1e6:.0f} million nodes, and "
            f"{MAX_REQUESTED_NODES / 1e6:.0f} million are the most. Give a larger one."
        )
    left = count_steps(spacing, settings) - 2
    fields = _compute_fields(deformed, spacing or settings.first, step)
    while left and (finer := find_finer_spacing(deformed, fields, settings)) is not None:
        fields, left = _compute_fields(deformed, finer, step), left - 2
    step(left)
    return fields


def find_finer_spacing(
    deformed: DeformedAnatomy, fields: WarpFields, settings: SpacingSettings = SpacingSettings()
) -> float | None:
    """Return a finer spacing [m] that is expected to meet the tolerance, within limits; None if there is no need."""
    now = fields.grid.spacing
    places = list_points(deformed)
    worst = float(places.compute_errors(fields)[places.tumour | places.landmarks].max(initial=0.0))
    if worst <= settings.tolerance:
        return None
    steps = math.floor(settings.safety_factor * now * settings.tolerance / worst / settings.step)
    steps = max(steps, round(MIN_SPACING / settings.step))
    while _count_nodes(deformed, settings.step * steps) > settings.max_nodes:
        steps += 1
    return settings.step * steps if steps < round(now / settings.step) else None


def _count_nodes(deformed: DeformedAnatomy, spacing: float) -> float:
    return float(np.prod(build_warp_grid(deformed.anatomy, deformed.displacement[None], spacing).shape, dtype=float))


def _compute_fields(deformed: DeformedAnatomy, spacing: float, step: Callable[[int], object]) -> WarpFields:
    return compute_warp_fields(deformed.anatomy, deformed.displacement, spacing, deformed.remaining, lambda: step(1))
