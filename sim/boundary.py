"""What holds a brain: the brainstem fast, the skull sliding or fast, and the craniotomy open."""

from __future__ import annotations

from typing import Literal

import numpy as np

from .anatomy import Anatomy
from .errors import InputError
from .geodesic import distances
from .mesh import TetMesh
from .normals import blurred_normals
from .placing import STEM

Skull = Literal["slide", "held"]
FEWEST_OPEN = 6  # nodes; fewer do not carry a tool
# [m], a standard deviation: the skull's inside is smoother than a brain, whose folds must not catch in it.
BLUR = 6e-3


def bounded(mesh: TetMesh, site: np.ndarray, craniotomy: float, skull: Skull) -> Anatomy:
    """The anatomy of `mesh` opened round `site` (3,) [m], a point at the cortex.

    Stem: surface nodes within 0.15 of the brain's height from the lowest one (least superior); held. Craniotomy:
    surface nodes within half of the diameter `craniotomy` [m] along the surface from the point nearest to `site`;
    free. Skull: the rest of the surface; it slides (no motion along the outward normal of the body seen through a
    blur of 6 mm) or is held.

    Raises
    ------
    InputError
        An opening with fewer than 6 nodes, or one that leaves no skull.
    """
    surface = mesh.surface
    outer = np.unique(surface)
    lowest = outer[mesh.nodes[outer, 2].argmin()]
    height = np.ptp(mesh.nodes[outer, 2])
    stem = np.zeros(len(mesh.nodes), bool)
    stem[outer] = np.linalg.norm(mesh.nodes[outer] - mesh.nodes[lowest], axis=1) <= STEM * height
    opened = (distances(mesh.nodes, surface, site, 0.5 * craniotomy) <= 0.5 * craniotomy) & ~stem
    if opened.sum() < FEWEST_OPEN:
        raise InputError(
            f"a craniotomy of {craniotomy * 1e3:g} mm holds {opened.sum()} mesh nodes, and {FEWEST_OPEN} are needed: "
            "ask for a larger one, or for more nodes."
        )
    rest = np.zeros(len(mesh.nodes), bool)
    rest[outer] = True
    rest &= ~stem & ~opened
    if not rest.any():
        raise InputError(f"a craniotomy of {craniotomy * 1e3:g} mm leaves no skull: ask for a smaller one.")
    held = stem | (rest & (skull == "held"))
    normals = np.zeros_like(mesh.nodes)
    if skull == "slide":
        normals[rest] = blurred_normals(mesh.nodes, surface, mesh.nodes[rest], BLUR)
    return Anatomy(mesh, np.repeat(held[:, None], 3, axis=1), normals, opened)
