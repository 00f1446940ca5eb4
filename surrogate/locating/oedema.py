"""Oedema: brain round a tumour that swells, or shrinks, while the rest does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from sim.anatomy import BRAIN_LABEL, PART_LABELS, Anatomy


def round_tumour(anatomy: Anatomy, reach: float) -> tuple[Anatomy, tuple[int, ...]]:
    """The body with brain that lies within `reach` [m] of its tumour as a region of its own, and labels of what swells.

    These are that region's, and that of oedema which the anatomy marks, as far as they are there. Tissue stays as it
    is where laws name no region but those of the anatomy.
    """
    mesh = anatomy.mesh
    tumour = KDTree(mesh.nodes[anatomy.tumour_nodes])
    away, _ = tumour.query(mesh.nodes[mesh.tets].mean(axis=1))
    own = int(mesh.region.max()) + 1
    region = np.where((mesh.region == BRAIN_LABEL) & (away < reach), own, mesh.region)
    swells = np.intersect1d(region, [own, PART_LABELS["oedema"]])
    return replace(anatomy, mesh=replace(mesh, region=region)), tuple(swells.tolist())
