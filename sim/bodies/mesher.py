"""Conforming tetrahedral mesh of brain and tumour with a requested number of nodes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import KDTree

from ..anatomy import BRAIN_LABEL, TUMOUR_LABEL
from ..errors import InputError
from ..geometry.surface import compute_areas
from ..geometry.tetmesh import SLIVER_DEGREES, TetMesh, find_boundary_faces
from .bcc_lattice import build_graded_lattice
from .isosurface_stuffing import CutMesh, IsosurfaceStuffingOptions, build_uncut_mesh, cut_mesh
from .manifold_repair import find_removable_tetrahedra, select_manifold
from .mesh_smoothing import Projection, Smoothing, compute_smallest_sines, fit_nodes, improve_mesh, prevent_folds
from .placement import TumourPiece
from .signed_distance import Field, project_onto_level

INTRICATE = "the surfaces are too intricate", "smooth the labels"
"""Reason why no number of nodes resolves a solid, and remedy."""
# Message if a solid has no tetrahedra.
TOO_COARSE = "so few nodes do not show the brain or the tumour: ask for more nodes, or check the labels."


@dataclass(frozen=True)
class Meshing:
    """Options for mesh size, for the search for the number of nodes, and for quality improvement.

    Parameters
    ----------
    tolerance, max_deviation
        Relative deviations from the requested number of nodes: the search ends below the first, fails above the second.
    max_trials
        Maximum number of lattices that the search builds.
    fine_size_ratio
        Cell size at the tumour and the craniotomy, the regions of interest, as a fraction of the coarsest cell size.
    cells_per_radius
        Minimum number of cells per tumour radius, to resolve the tumour's shape.
    edge_growth
        Growth of the cell edge per distance from the regions of interest.
    rounding
        Cells up to this factor above the requested size are not halved, so that sizes are correct on average.
    max_halvings
        Maximum number of halvings of the coarsest cell, which limits the lattice around a very small tumour.
    surface_tolerances
        Maximum distance of nodes from their surface while angles are improved [m], for each attempt.
    max_volume_error
        Maximum relative error of the tumour volume. Manual outlines of the same glioma differ more: Dice 74 to 85 %
        (Menze et al. 2015).
    min_meshed_fraction
        A tumour piece counts as lost if the mesh contains less than this fraction of its volume.
    factors
        Multiples of the number of nodes that are tried after a failure, to recommend a sufficient number.
    stuffing, smoothing
        Options of isosurface stuffing, and of the node moves that follow.
    """

    tolerance: float = 0.03
    max_deviation: float = 0.1
    max_trials: int = 8
    fine_size_ratio: float = 0.5
    cells_per_radius: float = 2.5
    edge_growth: float = 0.5
    rounding: float = 2.0**0.5
    max_halvings: int = 4
    surface_tolerances: tuple[float, ...] = (0.0, 3e-4, 6e-4, 1.2e-3, 2.4e-3)
    max_volume_error: float = 0.1
    min_meshed_fraction: float = 0.1
    factors: tuple[float, ...] = (1.25, 1.6, 2.0, 2.5)
    stuffing: IsosurfaceStuffingOptions = field(default_factory=IsosurfaceStuffingOptions)
    smoothing: Smoothing = field(default_factory=Smoothing)


@dataclass(frozen=True, eq=False)
class Solids:
    """Solids to be meshed.

    Parameters
    ----------
    brain, tumour
        Level sets of the whole solid (brain and tumour together) and of the tumour.
    low, high
        Corners (3,) [m] of a bounding box of the solid.
    tumour_volume
        Prescribed tumour volume [m^3], without pieces that the mesh does not resolve; matched as far as possible.
    interface_points, craniotomy_points
        Points (n, 3) [m] on the tumour's surface and on the cortex to be exposed, where the mesh is refined.
    pieces
        Connected components of the tumour, if there are several.
    """

    brain: Field
    tumour: Field
    low: np.ndarray
    high: np.ndarray
    tumour_volume: float
    interface_points: np.ndarray
    craniotomy_points: np.ndarray
    pieces: Sequence[TumourPiece] = ()


def build_mesh(solids: Solids, count: int, settings: Meshing = Meshing()) -> TetMesh:
    """Return the mesh of `solids` with `count` nodes; by default the deviation is at most 10 %, and mostly below 3 %.

    Raises
    ------
    InputError
        The nodes do not resolve the solid or the tumour volume; the message gives a sufficient number if 2.5 times as
        many nodes or fewer suffice. The search for a lattice size does not reach the number of nodes.
    """
    mesh = _build_mesh_or_reason(solids, count, settings)
    if isinstance(mesh, TetMesh):
        return mesh
    raise build_count_error(count, mesh, settings.factors, lambda number: _can_build_mesh(solids, number, settings))


def build_count_error(
    count: int, why: tuple[str, str], factors: Sequence[float], is_sufficient: Callable[[int], bool]
) -> InputError:
    """Return the error that `count` nodes do not resolve a solid, with the first sufficient multiple in `factors`."""
    reason, remedy = why
    numbers = (int(round(count * times, -2)) for times in factors)
    enough = next(filter(is_sufficient, numbers), None)
    return InputError(f"{reason} for {count} nodes: {'' if enough is None else f'ask for {enough}, or '}{remedy}.")


def find_lost_pieces(
    pieces: Sequence[TumourPiece], nodes: np.ndarray, tets: np.ndarray, settings: Meshing = Meshing()
) -> list[bool]:
    """Return True for each tumour piece that its tetrahedra, those in `tets` nearest to its surface, do not resolve."""
    if len(pieces) < 2:
        return [False for _ in pieces]
    owner = np.repeat(np.arange(len(pieces)), [len(piece.surface) for piece in pieces])
    surfaces, corners = KDTree(np.concatenate([piece.surface for piece in pieces])), nodes[tets]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    shown = np.bincount(owner[surfaces.query(corners.mean(axis=1))[1]], volume, len(pieces))
    return [bool(one < settings.min_meshed_fraction * piece.volume) for one, piece in zip(shown, pieces, strict=True)]


def describe_lost_pieces(pieces: Sequence[TumourPiece], is_lost: Sequence[bool]) -> str:
    """Return a text with the number of lost pieces and their total volume."""
    volume = sum(piece.volume for piece, missing in zip(pieces, is_lost, strict=True) if missing)
    return f"{sum(is_lost)} of the tumour's {len(pieces)} pieces, {1e6 * volume:.2g} ml in all"


def _can_build_mesh(solids: Solids, count: int, settings: Meshing) -> bool:
    try:
        return isinstance(_build_mesh_or_reason(solids, count, settings), TetMesh)
    except InputError:
        return False


def _build_mesh_or_reason(solids: Solids, count: int, settings: Meshing) -> TetMesh | tuple[str, str]:
    """Return the mesh with `count` nodes or, on failure, the reason and the remedy; errors as in `build_mesh`."""
    volume = float(np.prod(solids.high - solids.low))
    edge, best = (volume / count) ** (1.0 / 3.0), None
    for _ in range(settings.max_trials):
        pieces = cut_lattice(solids, edge, settings)
        reached = len(pieces.nodes)
        if best is None or abs(reached - count) < abs(len(best.nodes) - count):
            best = pieces
        if abs(reached - count) <= settings.tolerance * count:
            break
        edge *= float(np.clip((reached / count) ** 0.4, 0.5, 2.0))
    assert best is not None
    if abs(len(best.nodes) - count) > settings.max_deviation * count:
        raise InputError(f"{count} nodes are not possible for this anatomy (closest: {len(best.nodes)}): request more.")
    return _fit_mesh_or_reason(solids, best, settings)


def cut_lattice(solids: Solids, max_edge: float, settings: Meshing = Meshing()) -> CutMesh:
    """Return the solid, cut from a lattice with coarsest cell `max_edge` [m] and split along the tumour's surface."""
    radius = (0.75 / np.pi * solids.tumour_volume) ** (1.0 / 3.0)
    fine, growth = settings.fine_size_ratio * max_edge, settings.edge_growth
    tumour, craniotomy = KDTree(solids.interface_points), KDTree(solids.craniotomy_points)
    wanted = ((tumour, min(fine, radius / settings.cells_per_radius)), (craniotomy, fine))
    levels = min(int(np.rint(np.log2(max_edge / wanted[0][1]))), settings.max_halvings)

    def compute_size(points: np.ndarray) -> np.ndarray:
        return settings.rounding * np.min([least + growth * tree.query(points)[0] for tree, least in wanted], axis=0)

    lattice = build_graded_lattice(solids.low - max_edge, solids.high + max_edge, max_edge, levels, compute_size)
    body = cut_mesh(build_uncut_mesh(lattice), solids.brain, settings=settings.stuffing)
    if not body.is_inside.any():
        raise InputError(TOO_COARSE)
    body = body.select(body.is_inside)
    body = body.select(select_manifold(body.tets))
    surface = np.zeros(len(body.nodes), bool)
    surface[find_boundary_faces(body.tets)] = True
    return cut_mesh(body, solids.tumour, surface, settings.stuffing)


def _fit_mesh_or_reason(solids: Solids, pieces: CutMesh, settings: Meshing) -> TetMesh | tuple[str, str]:
    """Return the fitted mesh, or reason and remedy. A failed fit is repeated without moves that invert tetrahedra."""
    if not pieces.is_inside.any():
        raise InputError(TOO_COARSE)
    lost = find_lost_pieces(solids.pieces, pieces.nodes, pieces.tets[pieces.is_inside], settings)
    missing = sum(piece.volume for piece, one in zip(solids.pieces, lost, strict=True) if one)
    if missing > settings.max_volume_error * solids.tumour_volume:
        be = "is" if sum(lost) == 1 else "are"
        return f"{describe_lost_pieces(solids.pieces, lost)}, {be} too small", "leave what is small out of the labels"
    for fold in (True, False):
        found = _improve_pieces(
            solids, _fit_to_surfaces(solids, pieces, solids.tumour_volume - missing, settings, fold), settings
        )
        if compute_smallest_sines(found.nodes[found.tets]).min() >= np.sin(np.radians(SLIVER_DEGREES)):
            mesh = TetMesh(found.nodes, found.tets, np.where(found.is_inside, TUMOUR_LABEL, BRAIN_LABEL))
            volume = mesh.volumes[found.is_inside].sum()
            return mesh if abs(volume / solids.tumour_volume - 1.0) <= settings.max_volume_error else INTRICATE
    return INTRICATE


def _fit_to_surfaces(solids: Solids, pieces: CutMesh, volume: float, settings: Meshing, allow_folds: bool) -> CutMesh:
    """Return `pieces` with nodes fitted to the outer surface, then to the tumour's surface with `volume` [m^3].

    If `allow_folds` is False, nodes keep their position where a tetrahedron would be inverted.
    """
    (surface, _), smoothing = _mark_surfaces(pieces), settings.smoothing
    outer, inner = find_boundary_faces(pieces.tets), find_boundary_faces(pieces.tets[pieces.is_inside])
    nodes = fit_nodes(pieces.nodes, outer, solids.brain, surface, settings=smoothing)
    nodes = nodes if allow_folds else prevent_folds(pieces.nodes, nodes, pieces.tets)
    moved = fit_nodes(nodes, inner, solids.tumour, ~surface, volume, smoothing)
    return replace(pieces, nodes=moved if allow_folds else prevent_folds(nodes, moved, pieces.tets))


def _improve_pieces(solids: Solids, pieces: CutMesh, settings: Meshing) -> CutMesh:
    """Return `pieces` without flat tetrahedra on the surfaces, and with improved angles."""
    for slack in settings.surface_tolerances:
        bad = compute_smallest_sines(pieces.nodes[pieces.tets]) < settings.smoothing.good_sine
        pieces = pieces.select(~find_removable_tetrahedra(pieces.tets, bad))
        projection = _build_projection(solids, pieces, slack)
        pieces = replace(pieces, nodes=improve_mesh(pieces.nodes, pieces.tets, projection, settings.smoothing))
    return pieces


def _mark_surfaces(pieces: CutMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return two masks (V,): nodes on the outer surface, and nodes on the surface of the tumour."""
    marks = np.zeros((2, len(pieces.nodes)), bool)
    marks[0, find_boundary_faces(pieces.tets)] = True
    marks[1, find_boundary_faces(pieces.tets[pieces.is_inside])] = True
    return marks[0], marks[1]


def _build_projection(solids: Solids, pieces: CutMesh, slack: float) -> Projection:
    """Return a projection that keeps the level set value of each surface node within `slack` [m] of its current one."""
    surface, interface = _mark_surfaces(pieces)
    interface[np.setdiff1d(pieces.tets[pieces.is_inside], pieces.tets[~pieces.is_inside])] = False  # tumour cortex
    levels = solids.brain(pieces.nodes), solids.tumour(pieces.nodes)

    def project(points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        placed = points.copy()
        for solid, level, on in ((solids.tumour, levels[1], interface), (solids.brain, levels[0], surface)):
            rows = on[nodes]
            aim = level[nodes[rows]]
            placed[rows] = project_onto_level(
                solid, placed[rows], np.clip(solid(placed[rows]), aim - slack, aim + slack)
            )
        return placed

    return project


def compute_surface_errors(nodes: np.ndarray, triangles: np.ndarray, field: Field) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (15 S,) [m] from a field's surface at 15 points per triangle (S, 3), and their area weights."""
    spread = np.array([(i, j, 12 - i - j) for i in range(1, 12, 2) for j in range(1, 12 - i, 2)]) / 12.0
    corners = nodes[triangles]
    area, points = compute_areas(corners), np.einsum("pk,tki->tpi", spread, corners).reshape(-1, 3)
    return np.abs(field(points)), np.repeat(area / area.sum() / len(spread), len(spread))
