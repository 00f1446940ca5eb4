"""Named points of tissue with undeformed and deformed positions, which are interpolated in the FEM mesh."""

from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.geometry.closest_point import find_closest_points
from sim.geometry.locate import locate
from sim.geometry.tetmesh import compute_signed_volumes
from surrogate.locating.prior import compute_tumour_weights

TUMOUR, NEAREST, CORTEX = "tumour", "tumour, nearest to its centroid", "open cortex"  # Names of the landmarks.
CENTROID = "centroid of the tumour now"
"""Name of the deformed tumour's centroid in 3D Slicer."""
DESCRIPTIONS = {
    TUMOUR: "tissue at the centroid of the tumour's volume in the scan, as `sulcus locate` has it.",
    NEAREST: "that centroid lies outside the tissue; this is the tumour's point nearest to it.",
    CORTEX: "tissue on the surface, nearest to the middle of the open cortex in the scan.",
    CENTROID: "of the displaced tumour's volume. The tissue there may be another than in the scan.",
}
"""Description of each landmark, by name."""
INSIDE_TOLERANCE = 1e-9  # Tolerance within which a point belongs to a tetrahedron [m].


@dataclass(frozen=True, eq=False)
class Landmark:
    """Point of tissue: name, position in the scan (3,) [m], and deformed position (3,) [m]."""

    name: str
    rest: np.ndarray
    deformed: np.ndarray


def list_landmarks(body: Anatomy, displacement: np.ndarray) -> tuple[Landmark, ...]:
    """Return the landmarks of the tumour and of the open cortex, if present, under displacements (V, 3) [m].

    Landmarks are interpolated linearly in their tetrahedron or triangle, like the fields.
    """
    mesh, found = body.mesh, []
    if body.in_tumour.any():
        point = compute_tumour_weights(body) @ mesh.nodes
        at = locate(mesh, point[None])
        if np.linalg.norm(at.interpolate(mesh.nodes[None])[0, 0] - point) < INSIDE_TOLERANCE:
            found.append(Landmark(TUMOUR, point, point + at.interpolate(displacement[None])[0, 0]))
        else:
            triangles = body.tumour_surface
            (rest,), (triangle,), (weights,) = find_closest_points(point[None], mesh.nodes[triangles])
            found.append(Landmark(NEAREST, rest, rest + weights @ displacement[triangles[triangle]]))
    if len(body.open_surface):
        cortex = open_cortex(body)
        place = cortex.find_nearest(cortex.origin)
        found.append(Landmark(CORTEX, place.point, place.point + place.weights @ displacement[place.vertices]))
    return tuple(found)


def compute_centroid(body: Anatomy, displacement: np.ndarray) -> np.ndarray | None:
    """Return the centroid (3,) [m] of the deformed tumour; None without a tumour."""
    tumour = body.mesh.tets[body.in_tumour]
    if not len(tumour):
        return None
    now = body.mesh.nodes + displacement
    return np.average(now[tumour].mean(axis=1), axis=0, weights=compute_signed_volumes(now, tumour))
