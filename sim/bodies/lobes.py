"""Side and lobe of a tumour, from its relative position in the brain."""

import numpy as np

from ..anatomy import Anatomy

MIDLINE_DISTANCE = 5e-3  # Distance from the midline below which a tumour has no side [m].
LENGTH = 0.179  # Length of the brain of the reference points, from front to back [m].
FRONT, CROWN = 0.073, 0.082  # Most anterior and most superior coordinate of that brain [m].
LOBES = {
    "frontal": ((39, -6, 51), (18, 35, 42), (33, 33, 35), (48, 13, 19), (46, 30, 14), (31, 50, -10), (5, 5, 61)),
    "parietal": ((42, -23, 49), (23, -60, 59), (43, -46, 47), (56, -34, 30), (44, -61, 36), (7, -56, 48)),
    "temporal": ((53, -21, 7), (40, 15, -20), (56, -34, -2), (50, -28, -23), (31, -40, -20), (21, -16, -21)),
    "occipital": ((17, -84, 28), (32, -81, 16), (36, -78, -8), (7, -79, 6), (15, -68, -5)),
    "insular": ((35, 7, 3),),
    "deep": ((11, 11, 9), (24, 4, 2), (11, -18, 8)),
}
"""Centroids of gyri and nuclei by lobe, for both sides: MNI [mm] with x > 0 (Tzourio-Mazoyer et al. 2002)."""


def describe_location(anatomy: Anatomy) -> str:
    """Return the side and the approximate lobe of the tumour of an anatomy, such as "right parietal".

    Coordinates are scaled by the length of the brain, and the nearest point in `LOBES` gives the lobe. Displaced or
    infiltrated gyri are not recognised, so the lobe is a rough description, not a measurement.
    """
    nodes = anatomy.mesh.nodes
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    scale = LENGTH / (high[1] - low[1])
    centre = nodes[anatomy.tumour_nodes].mean(axis=0)
    aside = float(centre[0] - 0.5 * (low[0] + high[0]))
    place = np.array([abs(aside), centre[1] - high[1], centre[2] - high[2]]) * scale + [0.0, FRONT, CROWN]
    lobe = min(LOBES, key=lambda name: np.linalg.norm(1e-3 * np.array(LOBES[name]) - place, axis=1).min())
    side = "midline" if abs(aside) < MIDLINE_DISTANCE else "right" if aside > 0.0 else "left"
    return f"{side} {lobe}"
