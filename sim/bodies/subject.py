"""A head before it is meshed: what the template and a user's labels have in common."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from typing import cast

import numpy as np
from scipy import ndimage

from ..anatomy import BRAIN_LABEL, NECROSIS_LABEL, TUMOUR_LABEL, Anatomy
from ..errors import InputError
from ..geometry.tetmesh import TetMesh
from .boundary_conditions import add_boundary_conditions
from .dural_septa import Septum
from .intensity import Intensity
from .mesher import Meshing, Solids, build_mesh
from .placement import Piece, Placement, find_within_outline
from .refine import refined
from .signed_distance import Field

FEWEST_NODES, MOST_NODES = 2_000, 250_000
# Points spread over a tetrahedron (20, 4), by their shares of its corners.
SPREAD = np.array([corners for corners in product(range(4), repeat=4) if sum(corners) == 3]) / 4.0 + 1.0 / 16.0
SMALLEST_CRANIOTOMY, LARGEST_CRANIOTOMY = 0.015, 0.120  # [m]


@dataclass(frozen=True)
class MeshPlan:
    """How a subject becomes an anatomy.

    Parameters
    ----------
    nodes
        Wanted in the mesh.
    craniotomy
        [m] Diameter of the opening along the cortex.
    meshing
        How the mesh is searched for and smoothed.
    placement
        Where the brain is held, and how many nodes an opening needs.
    fine_opening
        Whether cells at the open cortex are halved, beyond the nodes wanted: contact forces depend less on the mesh.

    Raises
    ------
    InputError
        Nodes outside 2,000 to 250,000, or a craniotomy outside 15 to 120 mm.
    """

    nodes: int = 5300
    craniotomy: float = 0.050
    meshing: Meshing = field(default_factory=Meshing)
    placement: Placement = field(default_factory=Placement)
    fine_opening: bool = False

    def __post_init__(self) -> None:
        if not FEWEST_NODES <= self.nodes <= MOST_NODES:
            raise InputError(f"{self.nodes} nodes are outside {FEWEST_NODES} to {MOST_NODES}: choose a number between.")
        if not SMALLEST_CRANIOTOMY <= self.craniotomy <= LARGEST_CRANIOTOMY:
            raise InputError(
                f"a craniotomy of {self.craniotomy * 1e3:g} mm is outside {SMALLEST_CRANIOTOMY * 1e3:g} to "
                f"{LARGEST_CRANIOTOMY * 1e3:g} mm: choose a diameter between."
            )


@dataclass(frozen=True, eq=False)
class SubjectPart:
    """A part of brain or tumour that has a stiffness of its own: region label, field, and volume [m^3] in the labels.

    Necrosis is a part of the tumour, all else of the brain.
    """

    label: int
    inside: Field
    volume: float


@dataclass(frozen=True, eq=False)
class Subject:
    """A brain with a tumour, in the volume's RAS frame [m].

    Parameters
    ----------
    brain, tumour
        Fields of the whole solid (brain and tumour together) and of the tumour.
    cortex, interface
        Points (n, 3) [m] at the solid's surface and at the tumour's.
    tumour_volume
        [m^3].
    site
        (3,) [m]: the point of the cortex over which the skull is opened.
    intensity
        T1 intensities, where they are known.
    notes
        Sentences about what was changed in reading.
    pieces
        Of the tumour, the largest first.
    parts
        Regions of their own; of two that overlap the later counts.
    septa
        Sheets of dura that do not move.
    outline
        (n, 3) [m]: a closed curve round the opening, in place of a disc.
    """

    brain: Field
    tumour: Field
    cortex: np.ndarray
    interface: np.ndarray
    tumour_volume: float
    site: np.ndarray
    intensity: Intensity | None = None
    notes: tuple[str, ...] = ()
    pieces: tuple[Piece, ...] = ()
    parts: tuple[SubjectPart, ...] = ()
    septa: tuple[Septum, ...] = ()
    outline: np.ndarray | None = None


def make_anatomy(subject: Subject, plan: MeshPlan) -> Anatomy:
    """Mesh a subject and bound it. The same subject and plan give the same anatomy, bit by bit.

    Raises
    ------
    InputError
        What `build_mesh` and `add_boundary_conditions` refuse.
    """
    opening = subject.cortex[find_opened_cortex(subject, plan.craniotomy)]
    low, high = subject.cortex.min(axis=0), subject.cortex.max(axis=0)
    solids = Solids(
        subject.brain, subject.tumour, low, high, subject.tumour_volume, subject.interface, opening, subject.pieces
    )
    mesh = _with_parts(build_mesh(solids, plan.nodes, plan.meshing), subject)
    made = add_boundary_conditions(mesh, subject.site, plan.craniotomy, plan.placement, subject.outline, subject.septa)
    return refined(made, near_opening=True) if plan.fine_opening else made


def _with_parts(mesh: TetMesh, subject: Subject) -> TetMesh:
    """Return the mesh with the regions of the subject's parts.

    Each has those tetrahedra that lie in it with the largest share, as many as come nearest to its volume.
    """
    region = mesh.region.copy()
    for part in reversed(subject.parts):
        around = TUMOUR_LABEL if part.label == NECROSIS_LABEL else BRAIN_LABEL
        free = np.flatnonzero(region == around)
        points = np.einsum("pk,tki->tpi", SPREAD, mesh.nodes[mesh.tets[free]])
        share = (part.inside(points.reshape(-1, 3)) < 0.0).reshape(points.shape[:2]).mean(axis=1)
        touched = np.argsort(-share, kind="stable")[: np.count_nonzero(share)]
        taken = np.concatenate([[0.0], np.cumsum(mesh.volumes[free[touched]])])
        region[free[touched[: np.abs(taken - part.volume).argmin()]]] = part.label
    return TetMesh(mesh.nodes, mesh.tets, region) if subject.parts else mesh


def find_opened_cortex(subject: Subject, craniotomy: float) -> np.ndarray:
    """(n,) bool: which points of a subject's cortex lie under its outlined opening, or one of such a diameter [m].

    Distances are straight here. The mesh is opened by those along its surface, which are a little longer.
    """
    if subject.outline is not None:
        return find_within_outline(subject.cortex, subject.outline)
    return np.linalg.norm(subject.cortex - subject.site, axis=1) <= 0.5 * craniotomy


def find_rim(mask: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Centres (n, 3) [m] of the voxels of `mask` (I, J, K) that touch its outside."""
    padded = np.pad(mask, 1)
    index = np.argwhere(padded & ~cast(np.ndarray, ndimage.binary_erosion(padded))) - 1
    return index @ affine[:3, :3].T + affine[:3, 3]
