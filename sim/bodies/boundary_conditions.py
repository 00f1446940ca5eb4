"""Boundary conditions of a brain: nodes fixed at brainstem and dura, skull contact nodes, and the craniotomy."""

from collections.abc import Sequence
from functools import reduce

import numpy as np

from ..anatomy import Anatomy
from ..errors import InputError
from ..geometry.geodesic import compute_geodesic_distances
from ..geometry.surface import compute_vertex_normals
from ..geometry.tetmesh import TetMesh
from .dural_septa import Septum, find_fixed_vertices
from .placement import Placement, find_within_outline


def add_boundary_conditions(
    mesh: TetMesh,
    site: np.ndarray,
    diameter: float,
    settings: Placement,
    outline: np.ndarray | None = None,
    septa: Sequence[Septum] = (),
) -> Anatomy:
    """Return the anatomy with boundary conditions of a `mesh`, with a craniotomy around `site` (3,) [m] on the cortex.

    The brainstem is fixed: surface nodes within a fraction of the brain's height from the lowest (most inferior) node.
    The craniotomy is free: surface nodes within a geodesic distance of half its `diameter` [m] from the
    point nearest to `site` or, if an `outline` (n, 3) [m] is given, within this closed curve. Nodes at the dural
    sheets `septa` are fixed, except in the craniotomy.

    The skull covers the remaining surface; effects define the contact model. Each covered node i has a unit normal
    along the integral of grad N_i. If no node of linear tetrahedra moves along its normal, no volume passes through
    the skull (Engelman, Sani, Gresho 1982, Int. J. Numer. Methods Fluids 2:225-238).

    Raises
    ------
    InputError
        The craniotomy has too few nodes, or leaves no surface for the skull.
    """
    surface = mesh.surface
    outer = np.unique(surface)
    lowest, height = outer[mesh.nodes[outer, 2].argmin()], np.ptp(mesh.nodes[outer, 2])
    stem = np.zeros(len(mesh.nodes), bool)
    stem[outer] = np.linalg.norm(mesh.nodes[outer] - mesh.nodes[lowest], axis=1) <= settings.brainstem_radius * height
    said = f"a craniotomy of {diameter * 1e3:g} mm" if outline is None else "the outlined opening"
    if outline is None:
        opened = compute_geodesic_distances(mesh.nodes, surface, site, 0.5 * diameter) <= 0.5 * diameter
    else:
        opened = np.isin(np.arange(len(mesh.nodes)), outer) & find_within_outline(mesh.nodes, outline)
    opened &= ~stem
    if opened.sum() < settings.min_open_nodes:
        raise InputError(
            f"{said} holds {opened.sum()} mesh nodes, and {settings.min_open_nodes} are "
            "needed: ask for a larger one, or for more nodes."
        )
    fixed = reduce(np.logical_or, (find_fixed_vertices(mesh, septum) & ~opened for septum in septa), stem)
    rest = np.zeros(len(mesh.nodes), bool)
    rest[outer] = True
    rest &= ~fixed & ~opened
    if not rest.any():
        raise InputError(f"{said} leaves no skull: ask for a smaller one.")
    normals = np.where(rest[:, None], compute_vertex_normals(mesh.nodes, surface), 0.0)
    return Anatomy(mesh, np.repeat(fixed[:, None], 3, axis=1), normals, opened)
