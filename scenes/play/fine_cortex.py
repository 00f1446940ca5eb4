"""Fine visual surface of the cortex: gyri, sulci and vessels embedded in the FEM surface."""

from dataclasses import dataclass, replace

import numpy as np

from ar.rendering.embedding import EmbeddedSurface, build_embedded_surface
from sim.bodies.intensity import Intensity
from sim.geometry.tetmesh import TetMesh

from ..script.craniotomy_frame import CraniotomyFrame
from .gyri import build_cortex_maps

EDGE_LENGTH = 0.33e-3  # Largest edge of a triangle in the craniotomy [m].
EDGE_GROWTH = 0.6  # Growth of the largest edge with the distance from the craniotomy.
MAX_EDGE_LENGTH = 1.8e-3  # Largest edge of a triangle beyond the craniotomy [m].
CROWN_DEPTH = 0.25e-3  # Depth of crowns below the rounded FEM surface [m]: its facets limit the fine surface.
CUT_COLOUR = (0.80, 0.58, 0.46)  # Colour of the walls of a cavity (RGB, 0 to 1).


@dataclass(frozen=True, eq=False)
class FineCortex:
    """Fine surface embedded in the FEM surface with mesh vertices (n,), and the colours (m, 3) of its own vertices."""

    vertices: np.ndarray
    surface: EmbeddedSurface
    colour: np.ndarray


def build_fine_cortex(
    site: CraniotomyFrame, mesh: TetMesh, surface: np.ndarray, intensity: Intensity | None, edge: float = EDGE_LENGTH
) -> FineCortex:
    """Build the fine cortex on the surface triangles (S, 3) of an intact or a resected mesh.

    `edge`: largest edge of a triangle in the craniotomy [m].
    """
    vertices, triangles = np.unique(surface, return_inverse=True)

    def compute_edge_length(points: np.ndarray) -> np.ndarray:
        beyond = site.compute_axis_distance(points) - site.clearance
        return np.clip(edge + EDGE_GROWTH * beyond, edge, max(edge, MAX_EDGE_LENGTH))

    fine = build_embedded_surface(mesh.nodes[vertices], triangles, compute_edge_length)
    maps = build_cortex_maps(site, intensity).sample(site, fine.interpolate(mesh.nodes[vertices]))
    cut = fine.interpolate((~np.isin(vertices, site.anatomy.mesh.surface))[:, None].astype(float))
    depth = CROWN_DEPTH + (1.0 - cut[:, 0]) * maps[:, 0]
    return FineCortex(vertices, replace(fine, depth=depth), maps[:, 1:] + cut * (CUT_COLOUR - maps[:, 1:]))
