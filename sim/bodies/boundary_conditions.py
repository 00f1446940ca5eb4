"""Where a brain is held: at the brainstem and at sheets of dura; where a skull stands over it; and where it is open."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np

from ..anatomy import Anatomy
from ..errors import InputError
from ..geometry.geodesic import compute_geodesic_distances
from ..geometry.surface import compute_vertex_normals
from ..geometry.tetmesh import TetMesh
from .dural_septa import Septum, find_held_vertices
from .placement import Placement, find_within_outline


def add_boundary_conditions(
    mesh: TetMesh,
    site: np.ndarray,
    craniotomy: float,
    settings: Placement,
    outline: np.ndarray | None = None,
    septa: Sequence[Septum] = (),
) -> Anatomy:
    """Return the anatomy of `mesh` opened round `site` (3,) [m], a point at the cortex.

    The stem is held: surface nodes within a share of the brain's height from the lowest one (least superior). The
    craniotomy is free: surface nodes within half of the diameter `craniotomy` [m] along the surface from the point
    nearest to `site`. An `outline` (n, 3) [m] frees those within it instead. Sheets of dura, `septa`, hold what is at
    them, but for the craniotomy.

    The skull covers the rest of the surface, and effects say what it does. Each of its nodes has its
    unit normal n_i, along the integral of grad N_i. A body of linear tetrahedra whose nodes do not move along theirs
    passes no volume through the skull (Engelman, Sani, Gresho 1982, Int. J. Numer. Methods Fluids 2:225-238).

    Raises
    ------
    InputError
        An opening with too few nodes, or one that leaves no skull.
    """
    surface = mesh.surface
    outer = np.unique(surface)
    lowest = outer[mesh.nodes[outer, 2].argmin()]
    height = np.ptp(mesh.nodes[outer, 2])
    stem = np.zeros(len(mesh.nodes), bool)
    stem[outer] = np.linalg.norm(mesh.nodes[outer] - mesh.nodes[lowest], axis=1) <= settings.stem * height
    said = f"a craniotomy of {craniotomy * 1e3:g} mm" if outline is None else "the outlined opening"
    if outline is None:
        opened = compute_geodesic_distances(mesh.nodes, surface, site, 0.5 * craniotomy) <= 0.5 * craniotomy
    else:
        opened = np.isin(np.arange(len(mesh.nodes)), outer) & find_within_outline(mesh.nodes, outline)
    opened &= ~stem
    if opened.sum() < settings.fewest_open:
        raise InputError(
            f"{said} holds {opened.sum()} mesh nodes, and {settings.fewest_open} are "
            "needed: ask for a larger one, or for more nodes."
        )
    held = reduce(np.logical_or, (find_held_vertices(mesh, septum) & ~opened for septum in septa), stem)
    rest = np.zeros(len(mesh.nodes), bool)
    rest[outer] = True
    rest &= ~held & ~opened
    if not rest.any():
        raise InputError(f"{said} leaves no skull: ask for a smaller one.")
    normals = np.where(rest[:, None], compute_vertex_normals(mesh.nodes, surface), 0.0)
    return Anatomy(mesh, np.repeat(held[:, None], 3, axis=1), normals, opened)
